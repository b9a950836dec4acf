"""Importing the package imports hardly anything else, and needs neither the optimisers nor image processing."""

import importlib.util
import pkgutil
import subprocess
import sys

import pytest

import rbpf

HEAVY = ("gtsam", "pycolmap", "cv2")
FREE_TO_NEED_THEM = ("rbpf.validation", "rbpf.cli")

IMPORTED = """
import sys
before = set(sys.modules)
{statement}
top = {{name.split(".")[0] for name in set(sys.modules) - before}}
print(*sorted(name for name in top if name not in sys.stdlib_module_names and not name.startswith("_")))
"""

IMPORT_WITHOUT = """
import importlib, sys
for absent in {absent!r}:
    sys.modules[absent] = None
for name in {modules!r}:
    importlib.import_module(name)
"""


def run_python(source: str) -> str:
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def imported_by(statement: str) -> set[str]:
    """Packages outside of Python's own library that a statement imports."""
    return set(run_python(IMPORTED.format(statement=statement)).split())


def modules_that_need_no_heavy_import() -> list[str]:
    found = [module.name for module in pkgutil.walk_packages(rbpf.__path__, "rbpf.", onerror=raise_it)]
    return [name for name in ["rbpf", *found] if not name.startswith(FREE_TO_NEED_THEM)]


def raise_it(name: str) -> None:
    raise ImportError(name)


def test_importing_the_package_imports_hardly_anything_else():
    """Which is why it takes milliseconds, on a machine however busy."""
    assert imported_by("import rbpf") == {"rbpf", "lazy_loader"}


def test_the_command_line_keeps_blas_on_one_thread_before_numpy_is_there():
    """Which reads it as it is imported; who has set it otherwise is heeded."""
    early = "import sys, tyro; assert 'numpy' not in sys.modules"
    said = "import os, rbpf.cli; print(os.environ['OPENBLAS_NUM_THREADS'])"
    without = "import os; os.environ.pop('OPENBLAS_NUM_THREADS', None)"
    assert run_python(f"{without}\n{early}\n{said}").strip() == "1"
    assert run_python(f"import os; os.environ['OPENBLAS_NUM_THREADS'] = '3'\n{said}").strip() == "3"


@pytest.mark.slow
def test_the_public_names_need_neither_pictures_nor_what_only_tests_use():
    unwanted = {"matplotlib", "PIL", "rich", "tyro", "joblib", "jaxtyping", "pytest", "rerun", *HEAVY}
    assert not imported_by("from rbpf import *") & unwanted


@pytest.mark.slow
def test_everything_but_validation_imports_without_optimisers_and_image_processing():
    modules = modules_that_need_no_heavy_import()
    assert {"rbpf.sensors", "rbpf.motion", "rbpf.maps", "rbpf.systems"} <= set(modules)
    run_python(IMPORT_WITHOUT.format(absent=HEAVY, modules=modules))


def test_heavy_imports_are_there_to_be_blocked():
    for name in HEAVY:
        assert importlib.util.find_spec(name) is not None
