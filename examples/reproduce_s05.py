"""The figures of R. Sim et al. (2005) on the simulated laboratory: Table I, maps (Figs. 4–6), time per frame (Fig. 7).

The whole tour is 4,000 pairs over 68 m and takes hours to render and filter; --frames shortens it, --every thins it
out.
The maps that odometry alone builds, visual or of the wheels, have the filter's own sightings, averaged along its
path: they differ from one another by the paths only. Errors are those of places of landmarks as the true path would
have them, in metres, first in the world of the first camera, then after a rigid alignment.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.lie import SE3
from rbpf.sensors.pinhole import Pinhole, RectifiedStereo
from rbpf.sensors.readers.images import open_stereo
from rbpf.sensors.readers.wheel_odometry import read_wheel_odometry
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.run import StereoRun, run_images
from rbpf.validation.alignment import align
from rbpf.validation.scores import poses_at
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_lab import LabDrive, TexturedLab
from rbpf.validation.tables import write_table

PAPER = {200: (812, 0.62, 2109), 400: (1542, 4.02, 4194), 600: (2206, 6.87, 6264), 800: (2625, 11.48, 7674),
         1000: (3103, 14.98, 9399), 2000: (6213, 31.11, 19869), 3000: (8608, 48.64, 28719),
         4000: (11085, 65.71, 38394)}  # fmt: skip
"""Frame: landmarks per particle, distance by the wheels [m], SIFT features; Table I in part."""

PAPER_SECONDS = 11.9


class Paths(NamedTuple):
    """Poses (T, 7) relative to the first camera."""

    truth: np.ndarray
    filter: np.ndarray
    odometry: np.ndarray
    wheels: np.ndarray


@dataclass
class Record:
    """What happened pair by pair: rows of the table, and sightings as (name, pair, point in the camera)."""

    every: int
    rows: list[tuple[int, int, int]] = field(default_factory=list)
    sightings: list[tuple[np.ndarray, int, np.ndarray]] = field(default_factory=list)

    def __call__(self, t: int, run: StereoRun) -> None:
        """After pair t."""
        sensor, end = run.front_end.sensor, run.front_end
        if run.updated[t]:
            seen = sensor.names >= 0
            self.sightings.append((sensor.names[seen], t, end.for_filter().features.points[seen]))
        if (t + 1) % self.every == 0 or t + 1 == run.stamps_ns.size:
            self.rows.append((t + 1, int(sensor.manager.promoted.sum()), sensor.manager.next_name))

    def places(self, path: np.ndarray, names: np.ndarray) -> np.ndarray:
        """Mean places (M, 3) of landmarks (M,) along a path."""
        total, count = np.zeros((names.size, 3)), np.zeros(names.size)
        for seen, t, points in self.sightings:
            row = np.searchsorted(names, seen)
            held = (row < names.size) & (names[np.minimum(row, names.size - 1)] == seen)
            np.add.at(total, row[held], SE3.transform(path[t], points[held]))
            np.add.at(count, row[held], 1.0)
        return total / count[:, None]


def main(
    out: Path = Path("reproduce_s05"),
    frames: int = 4000,
    every: int = 1,
    particles: int = 400,
    dof: int = 3,
    width: int = 640,
    seed: int = 0,
    step: int = 200,
    texel_m: float = 0.003,
    quick: bool = False,
) -> dict[str, float]:
    """Renders the drive, unless it is there, and filters it.

    Args:
        out: folder for images, table and pictures.
        frames: pairs, the first of the tour.
        every: only each so many-th frame is a pair.
        particles: number of particles.
        dof: degrees of freedom; the paper's are 3.
        width: of the images, px.
        seed: of the images and of the filter.
        step: pairs between rows of the table.
        texel_m: side of a texel of the walls.
        quick: thirty coarse pairs and 100 particles, to see that it works.
    """
    if quick:
        frames, every, particles, width, step, texel_m = 30, 3, 100, 320, 15, 0.01
    images = out / "lab"
    if not images.exists():
        size = 0.78125 * width, 0.78125 * width, 0.5 * width - 0.5, 0.375 * width - 0.5
        rig = RectifiedStereo(Pinhole(width, 3 * width // 4, *size), 0.12)
        world = TexturedLab(LabDrive(frames=frames, every=every), texel_m=texel_m)
        simulate_images(world, Imaging(noise_std=8.0, known=0), rig, images, seed)
    record = Record(step)
    config = StereoConfig(particles=particles, dof=3 if dof == 3 else 6, seed=seed)
    run = run_images(open_stereo(images), config, record)
    paths = paths_of(run, images)
    table(run, record, paths, out)
    figures = errors(run, record, paths)
    write_table(out / "errors.csv", ["what", "m"], list(figures.items()))
    draw(run, record, paths, out)
    return figures


def paths_of(run: StereoRun, images: Path) -> Paths:
    """All four paths at the run's pairs."""
    wheels = read_wheel_odometry(images)
    by_wheels = wheels.world_from_camera(SE3.identity())
    _, by_wheels = poses_at(SE3, wheels.stamps_ns, by_wheels, run.stamps_ns)
    _, true = poses_at(SE3, run.truth.stamps_ns, run.truth.world_from_camera, run.stamps_ns)
    true, by_wheels = (SE3.between(path[0], path) for path in (true, by_wheels))
    return Paths(true, run.world_from_camera, run.odometry, by_wheels)


def table(run: StereoRun, record: Record, paths: Paths, out: Path) -> None:
    """Table I: ours, beside the paper's where it has that frame."""
    lengths = np.linalg.norm(np.diff(SE3.translation(paths.wheels), axis=0), axis=1)
    rows = []
    for frame, landmarks, features in record.rows:
        theirs = PAPER.get(frame, ("", "", ""))
        rows.append([frame, landmarks, float(lengths[: frame - 1].sum()), features, *theirs])
    header = [
        "frame",
        "landmarks",
        "distance m",
        "SIFT features",
        *(f"paper's {x}" for x in ("l.", "d.", "f.")),
    ]
    write_table(out / "table1.csv", header, rows)


def errors(run: StereoRun, record: Record, paths: Paths) -> dict[str, float]:
    """Root mean square errors of paths and maps, and times."""
    manager = run.front_end.sensor.manager
    names = manager.names[manager.promoted]
    figures: dict[str, float] = {}
    for name in ("filter", "odometry", "wheels"):
        path = getattr(paths, name)
        pairs = {
            "path": (SE3.translation(path), SE3.translation(paths.truth)),
            "map": (record.places(path, names), record.places(paths.truth, names)),
        }
        for what, (ours, true) in pairs.items():
            figures[f"{what}, {name}"] = rms(ours - true)
            figures[f"{what}, {name}, aligned"] = rms(align(ours, true).transform(ours) - true)
    figures["mean seconds per pair"] = float(run.seconds.mean())
    figures["the paper's"] = PAPER_SECONDS
    figures["mean ms of an update"] = 1e3 * float(
        (run.seconds_matching + run.seconds_filter)[run.updated > 0].mean()
    )
    return figures


def rms(off: np.ndarray) -> float:
    """Of lengths (K,)."""
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


def draw(run: StereoRun, record: Record, paths: Paths, out: Path) -> None:
    """Figs. 4–6 beside one another, seen from above, and Fig. 7."""
    manager = run.front_end.sensor.manager
    names = manager.names[manager.promoted]
    figure = Figure(figsize=(18.0, 6.0), layout="constrained")
    for axes, name in zip(figure.subplots(1, 3), ("filter", "odometry", "wheels"), strict=True):
        path = getattr(paths, name)
        places, at, true = record.places(path, names), SE3.translation(path), SE3.translation(paths.truth)
        axes.plot(places[:, 0], places[:, 2], "r.", ms=1, label="landmarks")
        axes.plot(true[:, 0], true[:, 2], "k--", lw=0.8, label="truth")
        axes.plot(at[:, 0], at[:, 2], lw=1.2, label=name)
        axes.set(title=f"map by {name}", xlabel="x [m]", ylabel="z [m]", aspect="equal")
        axes.legend(fontsize="small")
    figure.savefig(out / "maps.png", dpi=110)
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    axes = figure.subplots()
    stages = {
        name: 1e3 * getattr(run, f"seconds_{name}") for name in ("features", "odometry", "matching", "filter")
    }
    axes.stackplot(np.arange(run.seconds.size), *stages.values(), labels=list(stages), lw=0, alpha=0.7)
    axes.set(xlabel="pair", ylabel="ms", title="time per pair")
    axes.legend(fontsize="small")
    figure.savefig(out / "time.png", dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
