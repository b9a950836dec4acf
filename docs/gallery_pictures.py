"""Makes the pictures of the gallery: `python docs/gallery_pictures.py`; those of the README are `docs/pictures.py`'s.

docs/pictures/robot.png     a robot among landmarks, examples/range_bearing_robot.py
docs/pictures/vessel.png    a vessel seen by radar, examples/target_tracking.py
docs/pictures/evidence.png  two motion models compared, examples/motion_evidence.py
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "examples")]

import motion_evidence  # noqa: E402
import range_bearing_robot  # noqa: E402
import target_tracking  # noqa: E402

from rbpf import EkfProposal  # noqa: E402

COLOURS = 64


def shrink(source: Path, path: Path) -> None:
    """A picture with few colours: lines and letters need no more."""
    with Image.open(source) as picture:
        picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def draw_vessel(path: Path) -> None:
    """Where the radar saw a vessel, where it was, and where two filters of 100 particles put it."""
    truth, measurements = target_tracking.simulate(np.random.default_rng(0))
    filters: dict[str, Any] = {
        "bootstrap, all five numbers sampled": target_tracking.bootstrap(np.random.default_rng(100)),
        "turn rate and speed marginalised": target_tracking.marginalised(np.random.default_rng(100), EkfProposal()),
    }
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.subplots()
    distance, bearing = measurements.T
    axes.plot(distance * np.cos(bearing), distance * np.sin(bearing), ".", color="0.6", label="radar")
    axes.plot(truth[:, 1], truth[:, 2], color="black", label="true path")
    for name, filter_ in filters.items():
        path_of = np.array([filter_.step(z).estimate.mean[1:3] for z in measurements])
        axes.plot(*path_of.T, label=name)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


def main(out: Path = HERE / "pictures") -> None:
    """Runs the examples and keeps their pictures.

    Args:
        out: folder for the pictures.
    """
    with TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        draw_vessel(scratch / "vessel.png")
        motion_evidence.main(out=scratch)
        range_bearing_robot.main(out=scratch / "robot")
        shrink(scratch / "vessel.png", out / "vessel.png")
        shrink(scratch / "evidence.png", out / "evidence.png")
        shrink(scratch / "robot" / "map.png", out / "robot.png")


if __name__ == "__main__":
    tyro.cli(main)
