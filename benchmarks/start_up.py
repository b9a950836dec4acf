"""Start-up times: of the help, of a run's first frame, and of compiling the kernels at a first run."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rows import Row, Settings
from rbpf.sensors.camera import Pinhole
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images

ROOT = Path(__file__).resolve().parents[1]
CAMERA = Pinhole(240, 180, 190.0, 190.0, 119.5, 89.5)
UNTIL_THE_FIRST_FRAME = """
import os, sys
from rbpf.runs.run import Run
Run.take = lambda *_: os._exit(0)
from rbpf.cli import main
main(sys.argv[1:])
"""


def run(settings: Settings) -> list[Row]:
    """Median wall-clock seconds, each against Python with the required libraries."""
    turns = settings.repetitions(9)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        simulate_images(TexturedDesk(frames=2, texel_m=0.01), Imaging(), CAMERA, folder / "desk", seed=0)
        first = [UNTIL_THE_FIRST_FRAME, "run", "mono", str(folder / "desk"), "--out", str(folder / "run")]
        times = {
            name: np.median([seconds() for _ in range(turns)])
            for name, seconds in {
                "tyro": python("import tyro, rich.progress"),
                "help": python("from rbpf.cli import main; main(['--help'])"),
                "numba": python("import numba, scipy.linalg, cv2"),
                "first": python(*first),
            }.items()
        }
        (folder / "kernels").mkdir()
        compiled = python("from rbpf.cli import main; main(['doctor'])", NUMBA_CACHE_DIR=str(folder / "kernels"))
        cold, warm = compiled(), compiled()
    return [
        row("rbpf --help", times["help"], "its parser's import", times["tyro"]),
        row("rbpf run mono, before the first frame", times["first"], "import of Numba, SciPy, OpenCV", times["numba"]),
        row("first compilation", cold - warm, "the same from the cache", warm),
    ]


def python(*words: str, **environment: str) -> Callable[[], float]:
    """Measures the seconds of a separate process."""

    def seconds() -> float:
        start = time.perf_counter()
        command, variables = [sys.executable, "-c", *words], {**os.environ, **environment}
        subprocess.run(command, cwd=ROOT, env=variables, check=True, capture_output=True)
        return time.perf_counter() - start

    return seconds


def row(name: str, figure: float, floor: str, floor_s: float) -> Row:
    return Row(name, float(figure), "s", floor, float(floor_s), figure / floor_s, higher=False, tolerance=0.5)
