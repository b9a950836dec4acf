"""The same seed gives the same bytes, on one thread or two."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# Enough particles and observations for the drivers to want both threads.
RUN = """
import hashlib
import numba
from rbpf.kernels.signature import PAIRS_PER_THREAD
from tests.core.worlds import Recipe, content, drive, planar_world

numba.set_num_threads({threads})
filter_ = Recipe(n=2050, known={known}).build()
world = planar_world(8, landmarks=40, seed=6)
most = []
drive(filter_, world, after=lambda t, report: most.append(sum(group.z.shape[0] for group in report.groups)))
digest = hashlib.sha256()
for name, array in sorted(content(filter_).items()):
    digest.update(name.encode() + array.tobytes())
print(max(most) * filter_.n >= 2 * PAIRS_PER_THREAD, filter_.lineage.generation, digest.hexdigest())
"""


def run(threads: int, known: bool) -> str:
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)}
    source = RUN.format(threads=threads, known=known)
    done = subprocess.run(
        [sys.executable, "-c", source], env=environment, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_threads_do_not_change_a_byte(known):
    one, two = run(1, known), run(2, known)
    busy, generations, digest = one.split()
    assert busy == "True"
    assert int(generations) >= 1
    assert len(digest) == hashlib.sha256().digest_size * 2
    assert one == two
