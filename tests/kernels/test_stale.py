import os
import shutil
from pathlib import Path

import numba
import pytest

from rbpf import kernels
from rbpf.kernels.signature import discard_stale


def test_compiled_copies_older_than_a_kernel_source_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr("rbpf.kernels.signature.numba.config.CACHE_DIR", "")
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    old, new, other = (cache / name for name in ("a.f-1.py311.nbi", "a.g-9.py311.nbi", "a.pyc"))
    for path in (old, new, other):
        path.touch()
    os.utime(old, (0, 0))
    os.utime(other, (0, 0))
    os.utime(new, (4e9, 4e9))
    discard_stale(tmp_path)
    assert not old.exists()
    assert new.exists()
    assert other.exists()


def test_a_cache_folder_of_its_own_is_looked_at(tmp_path, monkeypatch):
    monkeypatch.setattr("rbpf.kernels.signature.numba.config.CACHE_DIR", str(tmp_path))
    (tmp_path / "module").mkdir()
    old = tmp_path / "module" / "a.f-1.py311.nbi"
    old.touch()
    os.utime(old, (0, 0))
    discard_stale(tmp_path / "elsewhere")
    assert not old.exists()


def test_where_no_folder_can_be_written_to_kernels_run_all_the_same(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(numba.config, "CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator")
    with pytest.raises(RuntimeError, match="no locator available"):
        numba.njit(cache=True)(discard_stale)
    with pytest.warns(UserWarning, match="compiled anew in every run, .* set NUMBA_CACHE_DIR to a folder"):
        kernels._use_a_cache()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    doubled = numba.njit("int64(int64)", cache=True)(lambda x: 2 * x)
    assert doubled(3) == 6 and list(folder.rglob("*.nbi"))
    shutil.rmtree(folder)
