"""Which part of monocular SLAM carries the error? The filter with perfect parts in turn, on the same measurements.

A sequence is filtered, and what was measured is adjusted in batch. Then the same measurements are filtered again:
without the matches that the batch shows to be wrong, with landmarks that start at the batch's depths, with ten times as
many particles, with the focal length and distortion that the batch prefers. The table has the error that remains; what
a perfect part takes away is what the filter's own part put in.
"""

from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.video import run_images
from rbpf.validation.mono import Recording
from rbpf.validation.mono_budget import AS_IT_IS, BATCH, Budget, error_budget
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk
from rbpf.validation.tables import write_table


def render(folder: Path, frames: int, width: int) -> Path:
    """A desk, unless it has been rendered before."""
    camera = Pinhole(width, 3 * width // 4, 0.8 * width, 0.8 * width, 0.5 * width - 0.5, 0.375 * width - 0.5)
    if not folder.exists():
        simulate_images(TexturedDesk(frames=frames), Imaging(), camera, folder, seed=0)
    return folder


def draw(budget: Budget, title: str, path: Path) -> None:
    """Bars of the errors, and the distance to the reference over the frames."""
    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.3))
    names = [line.name for line in budget.lines]
    mm = [1e3 * line.errors_m[budget.alignment] for line in budget.lines]
    colours = ["tab:orange" if name.startswith(BATCH) else "tab:blue" for name in names]
    bars = left.barh(names, mm, color=colours)
    left.bar_label(bars, fmt="%.3g", padding=2, fontsize="small")
    left.invert_yaxis()
    left.margins(x=0.15)
    left.set(xlabel=f"error [mm], against the {budget.against}", title=title)
    for line in budget.lines:
        dashed = "--" if line.name.startswith(BATCH) else "-"
        right.plot(line.frames, 1e3 * line.distances, dashed, lw=1.0, label=line.name)
    right.set(xlabel="frame", ylabel="distance [mm]", ylim=(0, None))
    right.legend(fontsize="x-small")
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def print_place(budget: Budget, frame: int, place: np.ndarray) -> None:
    """How far the camera is from where it should be in one frame, for a recording of which only that is known.

    Also from where the first frame is found: where the known points are uncertain, so is the place of their world.
    """
    for line in budget.lines:
        rows = np.flatnonzero(line.frames == frame)
        if not rows.size:
            continue
        pose = line.world_from_camera[rows[0]]
        from_first = SE3.between(line.world_from_camera[0], pose)
        fraction, own = (
            np.linalg.norm(at - place) / np.linalg.norm(place) for at in (pose[4:], from_first[4:])
        )
        print(
            f"{line.name:>24}: frame {frame} at {pose[4:].round(3)}, {fraction:.1%} off; "
            f"seen from the first frame {from_first[4:].round(3)}, {own:.1%} off"
        )


def main(
    images: Path | None = None,
    known_points: Path | None = None,
    seed: int = 0,
    frame: int | None = None,
    place: tuple[float, float, float] | None = None,
    out: Path = Path("demo/mono_budget"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs all variants and prints the table.

    Args:
        images: a folder of images or a video, with its camera.yaml; by default a desk is rendered.
        known_points: table of known points.
        seed: of the filter.
        frame: a frame whose place is known.
        place: where the camera is in it.
        out: folder for picture and table.
        quick: few small frames and few particles.
    """
    if images is None:
        images = render(out / "desk", 24 if quick else 300, 240 if quick else 640)
        known_points = images / "known_points.csv"
    out.mkdir(parents=True, exist_ok=True)
    sequence, known = Recording(images, known_points).open()
    run = run_images(sequence, MonoConfig(particles=10 if quick else 50, seed=seed), known)
    budget = error_budget(run, lambda name: print(f"filtering again: {name} …"))

    header = ["part", "no alignment [mm]", "rigid [mm]", "similarity [mm]"]
    kinds = ("none", "rigid", "similarity")
    rows = [[line.name, *(1e3 * line.errors_m[kind] for kind in kinds)] for line in budget.lines]
    print(
        f"{sequence.name}, against the {budget.against}; the {budget.alignment} column is the one that counts"
    )
    write_table(out / "budget.csv", header, rows)
    print(f"wrong matches: {budget.wrong:.2%}; calibration: {budget.calibration}")
    if frame is not None and place is not None:
        print_place(budget, frame, np.array(place))
    draw(budget, sequence.name, out / "budget.png")
    print(f"picture and table in {out}")
    return {line.name: line.errors_m[budget.alignment] for line in budget.lines} | {
        "as": budget.error(AS_IT_IS)
    }


if __name__ == "__main__":
    tyro.cli(main)
