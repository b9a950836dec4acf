"""Relocalisation after darkness: many blackouts of a run, one at a time.

Each sequence is filtered once, undisturbed, with checkpoints at equal intervals. From each checkpoint the run is
continued again, with a second of black images while the camera moves on, until it is tracked again or three seconds of
light have passed. The pose is compared with the ground truth a second after relocalisation: a recovery is *right* within
two seconds, right but late, *wrong* (more than 10 cm or 3° worse than the undisturbed run in the same frame), or missing.

The first table has a row per sequence, the second one per failure, with the progress of relocalisation: landmarks in
view from the true pose, the largest number of unambiguous matches of corners with landmarks, and of inliers of a pose.
`blackouts.csv` has all. Unmapped surroundings cannot be recognised: blackouts with fewer than `LEAST_VISIBLE` landmarks
in view are counted separately.

Without sequences a desk and a room are rendered. Sequences without ground truth are compared with the undisturbed run.
"""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.parallel import in_parallel
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.plots import save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import ImageFrame, ImageSequence, KnownPixels, open_images, read_known_points
from rbpf.sensors.readers.images.sequence import Source
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.relocalisation import Attempt
from rbpf.systems.system import Tracked
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images

SETTLED_S = 1.0
"""Time of tracking after which the pose is evaluated."""

RIGHT_M, RIGHT_DEG = 0.1, 3.0
"""Largest excess of a right pose's error over that of the undisturbed run in the same frame."""

Verdict = Literal["rightly", "late", "wrongly", "not"]


@dataclass(frozen=True)
class Blackouts:
    """The blackouts of a sequence.

    Attributes:
        folder: of the sequence.
        config: of the filter.
        count: number of blackouts, at equal intervals; fewer if there are too few frames.
        first_s: earliest time of the first one.
        dark_s: duration of darkness.
        within_s: how soon the camera must be found.
    """

    folder: Path
    config: MonoConfig
    count: int = 50
    first_s: float = 1.0
    dark_s: float = 1.0
    within_s: float = 2.0


@dataclass(frozen=True)
class Outcome:
    """The outcome of a blackout; T frames from the one before it on.

    Attributes:
        dark: number of dark frames.
        found: frame from which on the camera was not lost again; −1 for none.
        visible: landmarks of known depth in view at the end of darkness.
        errors_m: (T,) of the position.
        errors_deg: (T,) of the rotation.
        seconds_lost: median time of a bright frame in which it was still lost; NaN without one.
        attempts: at relocalisation, in the bright frames in which it was lost.
    """

    dark: range
    found: int
    visible: int
    errors_m: np.ndarray
    errors_deg: np.ndarray
    seconds_lost: float
    attempts: tuple[Attempt, ...]


@dataclass(frozen=True)
class Series:
    """All blackouts of a sequence.

    Attributes:
        name: of the sequence.
        rate_hz: of its images.
        within_s: how soon the camera must be found.
        outcomes: one per blackout.
        way_m: (B,) the camera's distance in the dark.
        usual_m: (T,) error of the undisturbed run's position, all frames.
        usual_deg: (T,) of its rotation.
    """

    name: str
    rate_hz: float
    within_s: float
    outcomes: list[Outcome]
    way_m: np.ndarray
    usual_m: np.ndarray
    usual_deg: np.ndarray

    def seconds(self, outcome: Outcome) -> float:
        """From the first bright image to relocalisation; infinite without it."""
        return (outcome.found - outcome.dark.stop) / self.rate_hz if outcome.found >= 0 else np.inf

    def judged(self, outcome: Outcome) -> int:
        """The frame in which the pose is evaluated: after some tracking, or the last."""
        last = outcome.dark.start - 2 + outcome.errors_m.size
        settled = max(outcome.found, outcome.dark.stop) + round(SETTLED_S * self.rate_hz)
        return min(settled, last)

    def error(self, outcome: Outcome) -> tuple[float, float]:
        """Error of the evaluated pose, m and degrees."""
        row = self.judged(outcome) - outcome.dark.start + 1
        return float(outcome.errors_m[row]), float(outcome.errors_deg[row])

    def verdict(self, outcome: Outcome) -> Verdict:
        """Relocalised in time, late, at a wrong pose, or not."""
        if outcome.found < 0:
            return "not"
        frame, (metres, degrees) = self.judged(outcome), self.error(outcome)
        if metres > self.usual_m[frame] + RIGHT_M or degrees > self.usual_deg[frame] + RIGHT_DEG:
            return "wrongly"
        return "rightly" if self.seconds(outcome) <= self.within_s else "late"


def pose_differences(poses: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (T,) [m] and angles (T,) [degrees] between poses (T, 7)."""
    error = SE3.log(SE3.between(reference, poses))
    metres = np.linalg.norm(SE3.translation(poses) - SE3.translation(reference), axis=-1)
    return np.asarray(metres), np.rad2deg(np.linalg.norm(error[..., :3], axis=-1))


@dataclass(frozen=True)
class Job:
    """One blackout.

    Attributes:
        folder: of the sequence.
        config: of the filter.
        checkpoint: of the undisturbed run, just before.
        dark: number of dark frames.
        end: frames from here on are not processed.
        settled: frames of tracking after which the run ends early.
        reference: (T, 7) poses taken as true.
    """

    folder: Path
    config: MonoConfig
    checkpoint: Path
    dark: range
    end: int
    settled: int
    reference: np.ndarray


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


class _EnoughError(Exception):
    """The camera has been tracked long enough."""


class _Watch:
    """Monitors one run from the start of darkness."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.run: Run | None = None
        self.done = 0
        self.visible = 0
        self.attempts: list[Attempt] = []

    def __call__(self, run: Run, _: Tracked) -> None:
        """Called after a frame."""
        t = len(run.log) - 1
        job, self.run, self.done = self.job, run, t + 1
        if t == job.dark.stop - 1:
            self.visible = in_view(run, job.reference[[job.dark.start - 1, job.dark.stop]])
        if t < job.dark.stop:
            return
        if run.system.attempt is not None:
            self.attempts.append(run.system.attempt)
        tracked = run.log.lost()[job.dark.stop : t + 1][-job.settled - 1 :]
        if tracked.size > job.settled and not tracked.any():
            raise _EnoughError


def black_out(job: Job) -> Outcome:
    """Continues from the checkpoint, first in the dark."""
    sequence, watch = open_images(job.folder), _Watch(job)
    dark = replace(sequence, source=Dark(sequence.source, job.dark, job.end))
    # The checkpoint is not changed.
    config = replace(job.config, checkpoint_every=job.end + 1)
    with suppress(_EnoughError):
        filter_opened(open_mono(dark, config, known_of(job.folder)), [watch], job.checkpoint, resume=True)
    run, done = watch.run, watch.done
    assert run is not None
    lit = np.arange(job.dark.stop, done)
    still_lost = run.log.lost()[lit]
    found = lit[~np.logical_or.accumulate(still_lost[::-1])[::-1]]
    span = slice(job.dark.start - 1, done)
    metres, degrees = pose_differences(run.log.poses[span], job.reference[span])
    lost = run.log["seconds"][lit][still_lost]
    seconds = float(np.median(lost)) if lost.size else np.nan
    attempts = tuple(watch.attempts)
    return Outcome(job.dark, int(found[0]) if found.size else -1, watch.visible, metres, degrees, seconds, attempts)


def run_series(blackouts: Blackouts, out: Path, workers: int = 1) -> Series:
    """Filters a sequence undisturbed, and repeatedly from checkpoints with darkness.

    Errors are relative to the ground truth, or without it to the undisturbed run.

    Args:
        blackouts: of the sequence.
        out: folder for the checkpoints; they are deleted at the end.
        workers: processes.

    Raises:
        InputError: the sequence cannot be filtered.
    """
    sequence = open_images(blackouts.folder)
    rate_hz = 1e9 / float(np.median(np.diff(sequence.stamps_ns)))
    dark, within, settled = (round(seconds * rate_hz) for seconds in (blackouts.dark_s, blackouts.within_s, SETTLED_S))
    total = len(sequence)
    starts = even_starts(round(blackouts.first_s * rate_hz), total - dark - within, blackouts.count)
    checkpoints = out / f"checkpoints_{blackouts.folder.name}"
    clean = undisturbed(sequence, blackouts, starts, checkpoints)
    reference = clean.log.poses if sequence.truth is None else nearest_truth(sequence)
    jobs = [
        Job(
            blackouts.folder,
            blackouts.config,
            checkpoints / f"{t:05d}.npz",
            range(t, t + dark),
            min(t + dark + within + settled, total),
            settled,
            reference,
        )
        for t in starts
    ]
    outcomes = in_parallel(black_out, jobs, workers)
    shutil.rmtree(checkpoints)
    place = SE3.translation(reference)
    way = np.array([np.linalg.norm(place[t + dark] - place[t]) for t in starts])
    usual = pose_differences(clean.log.poses, reference)
    return Series(blackouts.folder.name, rate_hz, blackouts.within_s, outcomes, way, *usual)


def even_starts(first: int, stop: int, count: int) -> list[int]:
    """At most `count` different frames from `first` to before `stop`, at equal intervals."""
    return np.unique(np.linspace(first, max(first, stop - 1), count).astype(int)).tolist()


def undisturbed(sequence: ImageSequence, blackouts: Blackouts, starts: list[int], out: Path) -> Run:
    """Filters the whole sequence; saves the states before the frames `starts` as `out`/TTTTT.npz."""
    out.mkdir(parents=True, exist_ok=True)

    def keep(run: Run, _: Tracked) -> None:
        if len(run.log) in starts:
            run.save(out / f"{len(run.log):05d}.npz")

    return filter_opened(open_mono(sequence, blackouts.config, known_of(blackouts.folder)), [keep])


def in_view(run: Run, truth: np.ndarray) -> int:
    """Landmarks of known depth in view from the camera's true pose; truth (2, 7) before and after."""
    pose = SE3.compose(run.system.loss.trusted[0], SE3.between(truth[0], truth[1]))
    _, points = run.system.loss.relocaliser.known_landmarks(run.system.filter.belief())
    return int(run.system.sensor.camera.visible(SE3.inverse_transform(pose, points)).sum())


def nearest_truth(sequence: ImageSequence) -> np.ndarray:
    """(T, 7) true world_from_camera of the nearest stamp for each image."""
    assert sequence.truth is not None
    nearest = np.abs(sequence.truth.stamps_ns[:, None] - sequence.stamps_ns).argmin(axis=0)
    return np.asarray(sequence.truth.poses[nearest])


def known_of(folder: Path) -> KnownPixels | None:
    """Known points of a folder, or None."""
    path = folder / "known_points.csv"
    return read_known_points(path) if path.exists() else None


LEAST_VISIBLE = 8
COLOURS = {"rightly": "tab:green", "late": "tab:olive", "wrongly": "tab:red", "not": "0.4"}


def simulated(out: Path, frames: int, quick: bool) -> list[Path]:
    """A desk and a room, rendered unless they exist; only the desk if `quick`."""
    size = (320, 240) if quick else (640, 480)
    camera = Pinhole(*size, 0.82 * size[0], 0.82 * size[0], 0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5)
    worlds: dict[str, Any] = {"desk": TexturedDesk(frames=frames, texel_m=0.002 if quick else 0.001)}
    if not quick:
        worlds["room"] = TexturedRoom(frames=frames)
    for name, world in worlds.items():
        if not (out / name).exists():
            simulate_images(world, Imaging(grid=1 if quick else 2), camera, out / name, seed=0)
    return [out / name for name in worlds]


def line(series: Series) -> list[str | int | float]:
    """A row of the first table."""
    verdicts = [series.verdict(one) for one in series.outcomes]
    fair = [one.visible >= LEAST_VISIBLE for one in series.outcomes]
    right = [verdict == "rightly" for verdict in verdicts]
    in_view = np.mean([r for r, f in zip(right, fair, strict=True) if f]) if any(fair) else np.nan
    seconds = [series.seconds(one) for one, r in zip(series.outcomes, right, strict=True) if r]
    counts = [verdicts.count(name) for name in ("rightly", "late", "wrongly", "not")]
    typical = float(np.median(seconds)) if seconds else np.nan
    return [series.name, len(verdicts), *counts, float(np.mean(right)), float(in_view), typical]


def details(series: Series, number: int) -> list[str | int | float]:
    """A row of one blackout."""
    one = series.outcomes[number]
    metres, degrees = series.error(one)
    pairs = max((attempt.matches for attempt in one.attempts), default=0)
    agreeing = max((attempt.agreeing for attempt in one.attempts), default=0)
    usual = float(series.usual_m[series.judged(one)])
    return [
        series.name, one.dark.start, series.verdict(one), float(series.way_m[number]), one.visible,
        series.seconds(one), metres, usual, degrees, pairs, agreeing, 1e3 * one.seconds_lost,
    ]  # fmt: skip


def draw(all_series: list[Series]) -> Figure:
    """Plots errors over time since the start of darkness, and time to recovery over distance."""
    figure = Figure(figsize=(12.0, 3.8 * len(all_series)), layout="constrained")
    rows = figure.subplots(len(all_series), 2, squeeze=False)
    for (over_time, over_way), series in zip(rows, all_series, strict=True):
        for one, way in zip(series.outcomes, series.way_m, strict=True):
            colour = COLOURS[series.verdict(one)]
            time = (np.arange(one.errors_m.size) - 1) / series.rate_hz
            over_time.semilogy(time, np.maximum(one.errors_m, 1e-4), lw=0.8, alpha=0.7, color=colour)
            if one.found >= 0:
                over_way.plot(way, series.seconds(one), "o", color=colour, ms=4)
            else:
                over_way.axvline(way, color=colour, lw=0.8, ls=":")
        over_time.set(title=series.name, xlabel="time since the light went out [s]", ylabel="error of position [m]")
        over_way.set(xlabel="way in the dark [m] (dotted: not found again)", ylabel="time to recovery [s]")
        for axes in (over_time, over_way):
            axes.grid(alpha=0.3)
    for name, colour in COLOURS.items():
        rows[0, 1].plot([], [], "o", color=colour, label=name)
    rows[0, 1].legend(fontsize="small")
    return figure


def main(
    sequences: tuple[Path, ...] = (),
    blackouts: int = 50,
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
    """Blacks out sequences for a second at many times; prints the rate of recovery.

    Args:
        sequences: with ground truth, for absolute errors; by default a desk and a room are rendered.
        blackouts: on each sequence, at most.
        first_s: earliest time of the first one.
        dark_s: duration of darkness.
        within_s: how soon the camera must be found.
        frames: of the rendered sequences.
        particles: of the filter.
        seed: of the filter.
        workers: processes.
        out: folder for picture, tables, checkpoints and rendered sequences.
        quick: two blackouts on a short desk with small images and few particles, not before 2 s: earlier, the map has
        too few landmarks of known depth for relocalisation.
    """
    if quick:
        blackouts, first_s, frames, particles = 2, 2.0, 165, 10
    config = MonoConfig(particles=particles, seed=seed)
    all_series = []
    for folder in sequences or simulated(out, frames, quick):
        plan = Blackouts(folder, config, blackouts, first_s, dark_s, within_s)
        all_series.append(run_series(plan, out, workers))
    header = ["sequence", "blackouts", "rightly", "late", "wrongly", "not", "share", "share in view", "median [s]"]
    write_table(out / "summary.csv", header, [line(series) for series in all_series])
    rows = [details(series, number) for series in all_series for number in range(len(series.outcomes))]
    header = [
        "sequence", "frame", "verdict", "way [m]", "in view", "found after [s]", "error [m]", "undisturbed [m]",
        "error [°]", "pairs", "agreeing", "lost frame [ms]",
    ]  # fmt: skip
    write_table(out / "blackouts.csv", header, rows, shown=False)
    if any(row[2] != "rightly" for row in rows):
        write_table(out / "failures.csv", header, [row for row in rows if row[2] != "rightly"])
    save_figures({"mono_blackouts.png": draw(all_series)}, out)
    print(f"picture and tables in {out}")
    return figures_of(all_series)


def figures_of(all_series: list[Series]) -> dict[str, float]:
    """Fractions over all sequences, and the errors after relocalisation."""
    pairs: list[tuple[Series, Outcome]] = [(series, one) for series in all_series for one in series.outcomes]
    verdicts = [series.verdict(one) for series, one in pairs]
    errors = [series.error(one)[0] for series, one in pairs if series.verdict(one) == "rightly"]
    figures = {
        "blackouts": float(len(verdicts)),
        "recovered": verdicts.count("rightly") / len(verdicts),
        "wrong": verdicts.count("wrongly") / len(verdicts),
        "median error a second later [m]": float(np.median(errors)) if errors else np.nan,
    }
    for name, figure in figures.items():
        print(f"{name}: {figure:.3g}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
