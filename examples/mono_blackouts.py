"""Does the camera find its way back after the light was out? Every blackout of a run, one at a time.

A sequence is filtered once, undisturbed, with a checkpoint every few frames. From each checkpoint the run is continued
once more, with a second of black images while the camera moves on, until it has had time to recover. The table has one
line per blackout: how far the camera went in the dark, how much of its map was still in view afterwards, how long it
took from the first image to finding itself, and the error of its position a second later beside that of the undisturbed
run. The picture has the error over time, and the time to recovery over the distance.

Without a sequence a desk is simulated. Where the light comes back on a place that the map does not know, nothing can be
recognised: such blackouts, with fewer than `LEAST_VISIBLE` landmarks in view, are counted apart.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.lie import SE3
from rbpf.sensors.pinhole import Pinhole
from rbpf.sensors.readers.images import ImageFrame, ImageSequence, KnownPixels, open_images, read_known_points
from rbpf.sensors.readers.images.sequence import Source
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.relocalise import known_places
from rbpf.systems.mono.video import VideoRun, run_images
from rbpf.validation.parallel import in_parallel
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk
from rbpf.validation.tables import Cell, write_table

LEAST_VISIBLE = 8


@dataclass(frozen=True)
class Dark(Source):
    """Images of another source, black from one frame to another, and none from `end` on."""

    source: Source
    dark: range
    end: int

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """From number `start` on."""
        for t, frame in enumerate(self.source.frames(start), start):
            if t >= self.end:
                return
            black = t in self.dark and frame.image is not None
            yield replace(frame, image=np.zeros_like(frame.image)) if black else frame


class Job(NamedTuple):
    """One blackout: the sequence, the checkpoint before it, and frames."""

    folder: Path
    config: MonoConfig
    checkpoint: Path
    dark: range
    end: int


class Recovered(NamedTuple):
    """After a blackout.

    Attributes:
        frame: number of the image from which on the camera was not lost again, −1 where there is none.
        visible: landmarks of known depth in view when the light came back.
        errors: (T,) of the position from the frame before the blackout on, metres.
        seconds_lost: median time of a frame with light in which it was still lost; NaN without one.
    """

    frame: int
    visible: int
    errors: np.ndarray
    seconds_lost: float


def blacked_out(job: Job) -> Recovered:
    """Continues from the checkpoint, in the dark at first."""
    sequence = open_images(job.folder)
    dark = replace(sequence, source=Dark(sequence.source, job.dark, job.end))
    visible = 0

    def look(t: int, frame: ImageFrame, run: VideoRun) -> None:
        nonlocal visible
        if t == job.dark.stop - 1:
            visible = in_view(run, true_poses(sequence)[[job.dark.start - 1, job.dark.stop]])

    # The checkpoint stays as it is.
    config = replace(job.config, checkpoint_every=job.end + 1)
    run = run_images(dark, config, known_of(job.folder), look, job.checkpoint, resume=True)
    lit = np.arange(job.dark.stop, run.lost.size)
    still_lost = run.lost[lit] == 1.0
    found = lit[~np.logical_or.accumulate(still_lost[::-1])[::-1]]
    poses = run.world_from_camera[job.dark.start - 1 :]
    errors = position_errors(poses, true_poses(sequence)[job.dark.start - 1 : job.end])
    lost = run.seconds[lit][still_lost]
    seconds = float(np.median(lost)) if lost.size else np.nan
    return Recovered(int(found[0]) if found.size else -1, visible, errors, seconds)


def in_view(run: VideoRun, truth: np.ndarray) -> int:
    """Landmarks of known depth that are in view from where the camera truly is; truth (2, 7) before and after."""
    pose = SE3.compose(run.recovery.trusted[0], SE3.between(truth[0], truth[1]))
    _, points = known_places(run.sensor, run.filter.belief(), run.config.recovery.depth_share)
    return int(run.sensor.camera.visible(SE3.inverse_transform(pose, points)).sum())


def true_poses(sequence: ImageSequence) -> np.ndarray:
    """(T, 7)."""
    assert sequence.truth is not None
    nearest = np.abs(sequence.truth.stamps_ns[:, None] - sequence.stamps_ns).argmin(axis=0)
    return np.asarray(sequence.truth.world_from_camera[nearest])


def known_of(folder: Path) -> KnownPixels | None:
    """Known points of a folder, None where there are none."""
    path = folder / "known_points.csv"
    return read_known_points(path) if path.exists() else None


def position_errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T,) metres."""
    return np.asarray(np.linalg.norm(SE3.translation(poses) - SE3.translation(truth), axis=-1))


def undisturbed(folder: Path, config: MonoConfig, first: int, out: Path) -> tuple[VideoRun, list[int]]:
    """Filters everything; checkpoints stay as `out`/TTTT.npz, from `first` on. Their frames are returned."""
    starts, latest = [], out / "latest.npz"

    def keep(t: int, frame: ImageFrame, run: VideoRun) -> None:
        if (t + 1) % config.checkpoint_every == 0 and t + 1 >= first:
            shutil.copy(latest, out / f"{t + 1:04d}.npz")
            starts.append(t + 1)

    out.mkdir(parents=True, exist_ok=True)
    return run_images(open_images(folder), config, known_of(folder), keep, latest), starts


def draw(done: list[Recovered], moved: np.ndarray, seconds: np.ndarray, rate_hz: float, path: Path) -> None:
    """Errors over time since the light went out; time to recovery over the distance in the dark."""
    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    over_time, over_distance = figure.subplots(1, 2)
    for one in done:
        over_time.semilogy((np.arange(one.errors.size) - 1) / rate_hz, one.errors, lw=0.8, alpha=0.7)
    over_time.set(xlabel="time since the light went out [s]", ylabel="error of position [m]")
    back = np.isfinite(seconds)
    visible = np.array([one.visible for one in done])
    dots = over_distance.scatter(moved[back], seconds[back], c=visible[back], cmap="viridis")
    for place in moved[~back]:
        over_distance.axvline(place, color="tab:red", lw=0.8, ls=":")
    over_distance.set(xlabel="way in the dark [m] (dotted: not found again)", ylabel="time to recovery [s]")
    figure.colorbar(dots, label="landmarks in view when the light came back")
    for axes in (over_time, over_distance):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def simulated(folder: Path, frames: int, quick: bool) -> Path:
    """A desk."""
    size = (320, 240) if quick else (640, 480)
    camera = Pinhole(*size, 0.82 * size[0], 0.82 * size[0], 0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5)
    world = TexturedDesk(frames=frames, texel_m=0.002 if quick else 0.001)
    if not folder.exists():
        simulate_images(world, Imaging(grid=1 if quick else 2), camera, folder, seed=0)
    return folder


def table(
    clean: VideoRun, truth: np.ndarray, starts: list[int], done: list[Recovered], dark: int, rate_hz: float
) -> tuple[np.ndarray, np.ndarray, list[list[Cell]]]:
    """Ways in the dark (B,), seconds to recovery (B,), infinite without one, and the lines of the table."""
    usual, place = position_errors(clean.world_from_camera, truth), SE3.translation(truth)
    way = np.array([np.linalg.norm(place[t + dark] - place[t]) for t in starts])
    found = np.array([one.frame if one.frame >= 0 else np.inf for one in done])
    seconds = (found - np.array(starts) - dark) / rate_hz
    rows: list[list[Cell]] = []
    for t, one, moved, wait in zip(starts, done, way, seconds, strict=True):
        later = min(max(one.frame, t + dark) + round(rate_hz), t - 2 + one.errors.size)
        errors = float(one.errors[later - t + 1]), float(usual[later])
        rows.append([t, float(moved), one.visible, float(wait), *errors, 1e3 * one.seconds_lost])
    return way, seconds, rows


def summary(done: list[Recovered], back: np.ndarray, rows: list[list[Cell]]) -> dict[str, float]:
    """Shares of the blackouts that were recovered from (B,), and errors of these."""
    fair = np.array([one.visible >= LEAST_VISIBLE for one in done])
    errors = np.array([row[4:6] for row in rows], dtype=float)[back]
    return {
        "blackouts": float(back.size),
        "recovered": float(back.mean()),
        "blackouts with landmarks in view": float(fair.sum()),
        "recovered with landmarks in view": float(back[fair].mean()),
        "median error a second later [m]": float(np.median(errors[:, 0])),
        "median error undisturbed [m]": float(np.median(errors[:, 1])),
    }


def main(
    sequence: Path | None = None,
    every: int = 15,
    first_s: float = 1.0,
    dark_s: float = 1.0,
    within_s: float = 2.0,
    frames: int = 900,
    particles: int = 50,
    seed: int = 0,
    workers: int = 1,
    out: Path = Path("demo/mono_blackouts"),
    quick: bool = False,
) -> dict[str, float]:
    """Blacks out a second at many places of a sequence; prints how often the camera finds itself again.

    Args:
        sequence: with ground truth; by default a desk is simulated.
        every: frames between the starts of blackouts.
        first_s: the first one is not before this.
        dark_s: how long the light is out.
        within_s: how soon the camera must be found.
        frames: of the simulated desk.
        particles: of the filter.
        seed: of the filter.
        workers: processes.
        out: folder for picture, table, checkpoints and desk.
        quick: a short desk, seen coarsely by few particles.
    """
    every, frames, particles = (30, 150, 10) if quick else (every, frames, particles)
    folder = sequence or simulated(out / "desk", frames, quick)
    config = MonoConfig(particles=particles, seed=seed, checkpoint_every=every)
    images = open_images(folder)
    rate_hz = 1e9 / float(np.median(np.diff(images.stamps_ns)))
    dark, after = round(dark_s * rate_hz), round((within_s + 1.0) * rate_hz)
    clean, starts = undisturbed(folder, config, round(first_s * rate_hz), out / "checkpoints")
    starts = [t for t in starts if t + dark + round(within_s * rate_hz) <= len(images)]
    jobs = [
        Job(folder, config, out / "checkpoints" / f"{t:04d}.npz", range(t, t + dark), t + dark + after)
        for t in starts
    ]
    done = in_parallel(blacked_out, jobs, workers)

    way, seconds, rows = table(clean, true_poses(images), starts, done, dark, rate_hz)
    header = [
        "frame",
        "way [m]",
        "in view",
        "found after [s]",
        "error [m]",
        "undisturbed [m]",
        "lost frame [ms]",
    ]
    write_table(out / "blackouts.csv", header, rows)
    figures = summary(done, seconds <= within_s, rows)
    for name, figure in figures.items():
        print(f"{name}: {figure:.3g}")
    draw(done, way, seconds, rate_hz, out / "mono_blackouts.png")
    print(f"picture and table in {out}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
