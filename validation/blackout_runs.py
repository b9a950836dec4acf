"""Runs with the light out: from checkpoints of an undisturbed run, one blackout at a time."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.readers.images import ImageFrame, ImageSequence, KnownPixels, open_images, read_known_points
from rbpf.sensors.readers.images.sequence import Source
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.likeness import known_places
from rbpf.systems.mono.relocalise import Attempt
from rbpf.systems.mono.resuming import save
from rbpf.systems.mono.video import VideoRun, run_images
from rbpf.validation.blackouts import SETTLED_S, Blackouts, Outcome, Series, pose_differences
from rbpf.validation.sweep.parallel import in_parallel


@dataclass(frozen=True)
class Job:
    """One blackout.

    Attributes:
        folder: of the sequence.
        config: of the filter.
        checkpoint: of the undisturbed run, just before.
        dark: frames without light.
        end: no frame from here on is looked at.
        settled: frames of tracking after which it ends early.
        reference: (T, 7) what counts as the true poses.
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
    """Follows one run after the light went out."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.run: VideoRun | None = None
        self.done = 0
        self.visible = 0
        self.attempts: list[Attempt] = []

    def __call__(self, t: int, frame: ImageFrame, run: VideoRun) -> None:
        """After a frame."""
        job, self.run, self.done = self.job, run, t + 1
        if t == job.dark.stop - 1:
            self.visible = in_view(run, job.reference[[job.dark.start - 1, job.dark.stop]])
        if t < job.dark.stop:
            return
        if run.recovery.relocaliser.attempt is not None and run.lost[t - 1]:
            self.attempts.append(run.recovery.relocaliser.attempt)
        tracked = run.lost[job.dark.stop : t + 1][-job.settled - 1 :]
        if tracked.size > job.settled and not tracked.any():
            raise _EnoughError


def black_out(job: Job) -> Outcome:
    """Continues from the checkpoint, in the dark at first."""
    sequence, watch = open_images(job.folder), _Watch(job)
    dark = replace(sequence, source=Dark(sequence.source, job.dark, job.end))
    # The checkpoint stays as it is.
    config = replace(job.config, checkpoint_every=job.end + 1)
    with suppress(_EnoughError):
        run_images(dark, config, known_of(job.folder), watch, job.checkpoint, resume=True)
    run, done = watch.run, watch.done
    assert run is not None
    lit = np.arange(job.dark.stop, done)
    still_lost = run.lost[lit] == 1.0
    found = lit[~np.logical_or.accumulate(still_lost[::-1])[::-1]]
    span = slice(job.dark.start - 1, done)
    metres, degrees = pose_differences(run.world_from_camera[span], job.reference[span])
    lost = run.seconds[lit][still_lost]
    seconds = float(np.median(lost)) if lost.size else np.nan
    attempts = tuple(watch.attempts)
    return Outcome(
        job.dark, int(found[0]) if found.size else -1, watch.visible, metres, degrees, seconds, attempts
    )


def run_series(blackouts: Blackouts, out: Path, workers: int = 1) -> Series:
    """Filters a sequence undisturbed, and again and again from checkpoints with the light out.

    Errors are against the ground truth; where there is none, against the undisturbed run.

    Args:
        blackouts: what is done.
        out: folder for the checkpoints; they are removed in the end.
        workers: processes.

    Raises:
        InputError: the sequence cannot be filtered.
    """
    sequence = open_images(blackouts.folder)
    rate_hz = 1e9 / float(np.median(np.diff(sequence.stamps_ns)))
    dark, within, settled = (
        round(seconds * rate_hz) for seconds in (blackouts.dark_s, blackouts.within_s, SETTLED_S)
    )
    total = len(sequence)
    starts = even_starts(round(blackouts.first_s * rate_hz), total - dark - within, blackouts.count)
    checkpoints = out / f"checkpoints_{blackouts.folder.name}"
    clean = undisturbed(sequence, blackouts, starts, checkpoints)
    reference = clean.world_from_camera if sequence.truth is None else nearest_truth(sequence)
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
    usual = pose_differences(clean.world_from_camera, reference)
    return Series(blackouts.folder.name, rate_hz, blackouts.within_s, outcomes, way, *usual)


def even_starts(first: int, stop: int, count: int) -> list[int]:
    """At most `count` different frames from `first` to before `stop`, at even distances."""
    return np.unique(np.linspace(first, max(first, stop - 1), count).astype(int)).tolist()


def undisturbed(sequence: ImageSequence, blackouts: Blackouts, starts: list[int], out: Path) -> VideoRun:
    """Filters everything; the states before the frames `starts` stay as `out`/TTTTT.npz."""
    out.mkdir(parents=True, exist_ok=True)

    def keep(t: int, frame: ImageFrame, run: VideoRun) -> None:
        if t + 1 in starts:
            save(run, out / f"{t + 1:05d}.npz")

    return run_images(sequence, blackouts.config, known_of(blackouts.folder), keep)


def in_view(run: VideoRun, truth: np.ndarray) -> int:
    """Landmarks of known depth that are in view from where the camera truly is; truth (2, 7) before and after."""
    pose = SE3.compose(run.recovery.trusted[0], SE3.between(truth[0], truth[1]))
    _, points = known_places(run.sensor, run.filter.belief(), run.config.relocalisation.depth_std_ratio)
    return int(run.sensor.camera.visible(SE3.inverse_transform(pose, points)).sum())


def nearest_truth(sequence: ImageSequence) -> np.ndarray:
    """(T, 7) true world_from_camera, for each image that of the nearest stamp."""
    assert sequence.truth is not None
    nearest = np.abs(sequence.truth.stamps_ns[:, None] - sequence.stamps_ns).argmin(axis=0)
    return np.asarray(sequence.truth.world_from_camera[nearest])


def known_of(folder: Path) -> KnownPixels | None:
    """Known points of a folder, None where there are none."""
    path = folder / "known_points.csv"
    return read_known_points(path) if path.exists() else None
