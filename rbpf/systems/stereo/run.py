"""Runs stereo SLAM over a recording, and gathers what it says of every pair."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.checkpoint import checked, fitting
from rbpf.core.filter import Filter
from rbpf.core.particles import Estimate
from rbpf.errors import InputError
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import CameraTruth, FeatureLog
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.feature_cache import CachedSequence
from rbpf.systems.stereo.landmarks import FeatureKind, Landmarks
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.system import Tracked

_SHAPES = {"world_from_camera": (7,), "cov": (6, 6), "odometry": (7,)}
_NAMES = [
    "features",
    "agreeing",
    "assumed",
    "updated",
    "observed",
    "ess",
    "resampled",
    "log_evidence",
    "nis",
    "nis_dof",
]
_SECONDS = ("seconds", "seconds_features", "seconds_odometry", "seconds_matching", "seconds_filter")
_PER_FRAME = (*_SHAPES, *_NAMES, *_SECONDS)


@dataclass(frozen=True)
class PairSeen:
    """What one pair showed.

    Attributes:
        z: (K, 3) pixels (u_left, v, u_right) of its features.
        kind: (K,) what each was.
    """

    z: np.ndarray
    kind: np.ndarray

    def of(self, kind: FeatureKind) -> np.ndarray:
        """Pixels (k, 3) of one kind."""
        return np.asarray(self.z[self.kind == kind], dtype=float)


@dataclass
class StereoRun:
    """A run over T pairs; the columns of `StereoSlam` are attributes, (T, …) each.

    Attributes:
        name: of the recording.
        truth: where the camera really was; None where unknown.
        slam: in its final state.
        stamps_ns: (T,).
        per_stamp: nanoseconds per unit of `stamps_ns`: 1, or 10⁹ where stamps count pairs of unknown time.
        notes: what was wrong with single pairs, in words.
        failure: why it ended before the last pair, in words; None where it did not.
        frames_done: pairs so far.
        shown: what each pair showed, see `StereoSlam.observed`.
    """

    name: str
    truth: CameraTruth | None
    slam: StereoSlam
    stamps_ns: np.ndarray
    per_stamp: int = 1
    notes: list[str] = field(default_factory=list)
    failure: str | None = None
    frames_done: int = 0
    shown: list[dict[str, np.ndarray]] = field(default_factory=list)
    world_from_camera: np.ndarray = field(init=False)
    cov: np.ndarray = field(init=False)
    odometry: np.ndarray = field(init=False)
    features: np.ndarray = field(init=False)
    agreeing: np.ndarray = field(init=False)
    assumed: np.ndarray = field(init=False)
    updated: np.ndarray = field(init=False)
    observed: np.ndarray = field(init=False)
    ess: np.ndarray = field(init=False)
    resampled: np.ndarray = field(init=False)
    log_evidence: np.ndarray = field(init=False)
    nis: np.ndarray = field(init=False)
    nis_dof: np.ndarray = field(init=False)
    seconds: np.ndarray = field(init=False)
    seconds_features: np.ndarray = field(init=False)
    seconds_odometry: np.ndarray = field(init=False)
    seconds_matching: np.ndarray = field(init=False)
    seconds_filter: np.ndarray = field(init=False)
    _measured: list[bool] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in _PER_FRAME:
            setattr(self, name, np.zeros((self.stamps_ns.size, *_SHAPES.get(name, ()))))

    @property
    def config(self) -> StereoConfig:
        """With what settings."""
        return self.slam.config

    @property
    def rig(self) -> RectifiedStereo:
        """The cameras."""
        return self.slam.rig

    @property
    def filter(self) -> Filter:
        """In its final state."""
        return self.slam.filter

    @property
    def landmarks(self) -> Landmarks[Any]:
        """What is known of the map's landmarks besides where they are."""
        return self.slam.front_end.landmarks

    @property
    def at_update(self) -> Estimate:
        """The estimate at the last update."""
        return self.slam.at_update

    def pair_seen(self, t: int) -> PairSeen:
        """What pair t showed, for pictures."""
        return PairSeen(self.shown[t]["z"].astype(np.float32), self.shown[t]["kind"])

    @property
    def seen(self) -> list[PairSeen]:
        """What each pair showed, for pictures."""
        return [self.pair_seen(t) for t in range(len(self.shown))]

    def log(self) -> FeatureLog:
        """The pixels that the pairs were filtered by, as tracks; of named pixels the given ones."""
        return replace(self.slam.measurements(self.name, _Recorded(self)), truth=self.truth)

    def summary(self) -> dict[str, Any]:
        """Entries of summary.json."""
        return self.slam.summary(_Recorded(self))

    def record(self, tracked: Tracked, seconds: float) -> None:
        """The next pair."""
        t = self.frames_done
        self.world_from_camera[t], self.cov[t], self.seconds[t] = tracked.pose, tracked.cov, seconds
        for name in ("odometry", *_NAMES, *_SECONDS[1:]):
            getattr(self, name)[t] = tracked.values[name]
        self._measured.append(bool(tracked.values["measured"]))
        self.notes += [f"pair {t}: {message}" for message in tracked.messages]
        self.shown.append(dict(tracked.observed))
        self.frames_done = t + 1

    def save(self, path: Path) -> None:
        """Writes a checkpoint of everything so far."""
        done = self.frames_done
        arrays = {f"progress/{name}": getattr(self, name)[:done] for name in _PER_FRAME}
        arrays["progress/stamps_ns"] = self.stamps_ns
        arrays["progress/notes"] = np.array(self.notes, dtype=np.str_)
        arrays["progress/measured"] = np.array(self._measured, dtype=bool)
        arrays["observed/counts"] = np.array([len(shown["z"]) for shown in self.shown], dtype=np.int64)
        for ragged in StereoSlam.observed:
            empty = np.zeros((0, *ragged.shape), dtype=ragged.kind)
            rows = [shown[ragged.name].astype(ragged.kind) for shown in self.shown]
            arrays[f"observed/{ragged.name}"] = np.concatenate([empty, *rows])
        self.slam.save(path, arrays)

    def load(self, path: Path) -> None:
        """The inverse of `save`.

        Raises:
            InputError: the file is damaged, or belongs to a run over another recording or with other settings.
        """
        arrays = self.slam.load(path)
        if not np.array_equal(arrays.get("progress/stamps_ns", ()), self.stamps_ns):
            raise InputError(f"{path} belongs to a run over another recording: start without --resume")
        with fitting(path):
            self._measured = checked(arrays, "progress/measured", (None,), "b").tolist()
            self.frames_done = len(self._measured)
            for name in _PER_FRAME:
                getattr(self, name)[: self.frames_done] = arrays[f"progress/{name}"]
            self.notes = checked(arrays, "progress/notes", (None,), "U").tolist()
            cuts = np.cumsum(arrays["observed/counts"])[:-1]
            names = [ragged.name for ragged in StereoSlam.observed]
            parts = [np.split(arrays[f"observed/{name}"], cuts) for name in names]
            self.shown = [dict(zip(names, rows, strict=True)) for rows in zip(*parts, strict=True)]


class _Recorded:
    """A run as `System.measurements` and `System.summary` take it."""

    def __init__(self, run: StereoRun) -> None:
        self._run = run

    @property
    def stamps_ns(self) -> np.ndarray:
        return self._run.stamps_ns

    @property
    def poses(self) -> np.ndarray:
        return self._run.world_from_camera

    def __len__(self) -> int:
        return self._run.frames_done

    def __getitem__(self, name: str) -> np.ndarray:
        return np.array(self._run._measured) if name == "measured" else getattr(self._run, name)

    def observed(self, t: int) -> dict[str, np.ndarray]:
        return self._run.shown[t]

    def lost(self) -> np.ndarray:
        return np.zeros(len(self), dtype=bool)


def run_images(
    sequence: ImageSequence | CachedSequence,
    config: StereoConfig,
    on_frame: Callable[[int, StereoRun], None] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
) -> StereoRun:
    """Filters a sequence of pairs of images.

    A pair that cannot be measured is passed over, and said in `notes`. What was computed before one that cannot be
    filtered is kept: the run is then shorter and has a `failure`.

    Args:
        sequence: the recording, or its features.
        config: all settings.
        on_frame: called after each pair; a KeyboardInterrupt from it leaves a checkpoint behind.
        checkpoint: file of checkpoints; None writes none.
        resume: go on from the checkpoint, if there is one.

    Raises:
        InputError: the first pair is refused, or the checkpoint is of another run.
    """
    stamps = np.asarray(sequence.stamps_ns, dtype=np.int64)
    run = StereoRun(sequence.name, sequence.truth, StereoSlam(sequence.rig, config), stamps)
    if resume and checkpoint is not None and checkpoint.exists():
        run.load(checkpoint)
    done = run.frames_done
    return _all(run, sequence.frames(done) if done < len(sequence) else iter(()), on_frame, checkpoint)


def run_features(
    log: FeatureLog,
    config: StereoConfig,
    on_frame: Callable[[int, StereoRun], None] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
) -> StereoRun:
    """Filters a log of named pixels of a stereo pair; see `run_images`.

    A log without times, whose stamps count its frames, is taken as one frame per second.

    Raises:
        InputError: the log is of one camera, or the checkpoint is of another run.
    """
    if not isinstance(log.camera, RectifiedStereo):
        raise InputError(
            f"{log.name}: stereo SLAM needs a log of a rectified pair, this one is of one camera"
        )
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    run = StereoRun(log.name, log.truth, StereoSlam(log.camera, config), stamps)
    if np.array_equal(stamps, np.arange(stamps.size)):
        run.per_stamp = 1_000_000_000
    if resume and checkpoint is not None and checkpoint.exists():
        run.load(checkpoint)
    rest = (replace(f, stamp_ns=run.per_stamp * f.stamp_ns) for f in log.frames[run.frames_done :])
    return _all(run, rest, on_frame, checkpoint)


def _all(
    run: StereoRun,
    frames: Iterator[Any],
    on_frame: Callable[[int, StereoRun], None] | None,
    checkpoint: Path | None,
) -> StereoRun:
    for t, frame in enumerate(frames, run.frames_done):
        started = time.perf_counter()
        try:
            tracked = run.slam.take(frame)
        except InputError as error:
            if t == 0:
                raise
            run.failure = f"pair {t} of {run.name}: {error}"
            break
        run.record(tracked, time.perf_counter() - started)
        if checkpoint is not None and (t + 1) % run.config.checkpoint_every == 0:
            _keep(run, checkpoint)
        try:
            if on_frame is not None:
                on_frame(t, run)
        except KeyboardInterrupt:
            if checkpoint is not None:
                _keep(run, checkpoint)
            raise
    if checkpoint is not None and run.failure is None:
        _keep(run, checkpoint)
    run.stamps_ns = run.stamps_ns[: run.frames_done]
    for name in _PER_FRAME:
        setattr(run, name, getattr(run, name)[: run.frames_done])
    return run


def _keep(run: StereoRun, checkpoint: Path) -> None:
    """Writes a checkpoint; where the disk is full the run goes on all the same, and the last one stays."""
    try:
        run.save(checkpoint)
    except InputError as error:
        run.notes.append(f"pair {run.frames_done - 1}: no checkpoint is kept: {error}")
