"""Reproduction of the figures of E. Eade and T. Drummond (2006) with the monocular system.

Sequences are rendered (into `OUT/sequences`), filtered with the default settings from a few known points, and
evaluated. Each figure gives a plot, `figure_N.png`; the table compares the paper's values with ours, and marks those
that are worse.

    python -m examples.studies.reproduce_e06 --figures 4 5

2: likelihood of depth and of inverse depth, of features tracked in images.
3: time per frame by the number of landmarks.
4: coplanarity of the landmarks of a flat desk.
5: loop closure.
6: three thousand frames in real time.
7: (and 8) new landmarks on their rays, and on their epipolar lines.
9: a camera at rest before four points of a plane, with and without the epipolar constraint.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import tyro

from examples.studies.e06 import depth_from_images, long_run, loop, many_landmarks, new_landmarks, plane, still_camera
from examples.studies.e06.setting import Row, Setting
from rbpf.errors import InputError
from rbpf.runs.files import write_table

FIGURES: dict[int, Callable[[Setting], list[Row]]] = {
    2: depth_from_images.reproduce,
    3: many_landmarks.reproduce,
    4: plane.reproduce,
    5: loop.reproduce,
    6: long_run.reproduce,
    7: new_landmarks.reproduce,
    9: still_camera.reproduce,
}
ALSO = {8: 7}
"""Figures that are produced together with others."""


def main(
    figures: tuple[int, ...] = tuple(FIGURES),
    out: Path = Path("demo/reproduce_e06"),
    width: int = 640,
    particles: int = 50,
    seed: int = 0,
    quick: bool = False,
    map: Literal["particles", "auto"] = "particles",
) -> dict[str, float]:
    """Reproduces figures of the paper; prints the table.

    Args:
        figures: their numbers.
        out: folder for plots, table and sequences.
        width: of the images, px; figure 6 has its own.
        particles: of the filter.
        seed: of worlds and filter.
        quick: few small frames.
        map: per-particle maps, as in the paper, or the system's default, the joint map.
    """
    wanted = sorted({ALSO.get(figure, figure) for figure in figures})
    unknown = [figure for figure in wanted if figure not in FIGURES]
    if unknown:
        raise InputError(f"there is no figure {unknown[0]} to reproduce: choose from {[*FIGURES, *ALSO]}")
    out.mkdir(parents=True, exist_ok=True)
    setting = Setting(out, width, particles, seed, quick, map)
    rows = [row for figure in wanted for row in FIGURES[figure](setting)]
    header = ["figure", "what", "paper", "ours", "as asked"]
    write_table(out / "table.csv", header, [[row.figure, row.what, row.paper, row.ours, row.verdict] for row in rows])
    short = sum(row.met is False for row in rows)
    print(f"{short} of {sum(row.met is not None for row in rows)} comparisons fall short; pictures and table in {out}")
    return {f"{row.figure}: {row.what}": row.value for row in rows}


if __name__ == "__main__":
    tyro.cli(main)
