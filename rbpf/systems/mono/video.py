"""Takes a sequence of images through `MonoSlam`, and gathers what it reports."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from rbpf.core.checkpoint import checked, fitting
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.readers import ImageFrame, ImageSequence, KnownPixels
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.known_map import KnownMap
from rbpf.systems.mono.slam import MonoSlam

_PER_FRAME = (
    "searched", "found", "lost", "ess", "log_evidence", "resampled", "nis", "nis_dof", "points", "rays",
    "seconds_search", "seconds_new_landmarks",
)  # fmt: skip


@dataclass(frozen=True)
class SearchRecord:
    """What `MonoSlam.observed` says of one frame: K features that were looked for, J that were started."""

    features: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    px: np.ndarray
    cov_px: np.ndarray
    line: np.ndarray
    position: np.ndarray
    started: np.ndarray
    started_px: np.ndarray

    @property
    def found(self) -> np.ndarray:
        """(K,) whether each was found."""
        return np.isfinite(self.px).all(axis=1)

    @property
    def is_ray(self) -> np.ndarray:
        """(K,) whether its depth was still unknown after the frame."""
        return np.isfinite(self.line).all(axis=(1, 2))


@dataclass
class VideoRun:
    """A run over T images.

    Attributes:
        sequence: what was filtered.
        config: with what settings.
        known: the known points, None where it started without any.
        mapped: the map that the camera is found in, and that is not changed; None where the run makes its own.
        slam: the system as it is now.
        stamps_ns: (T,).
        world_from_camera: (T, 7) online filtered mean, in the world of the known points, else of the first camera; the
            frames of a start without known points are revised at its end, when there is a scale to report them in.
        cov: (T, 6, 6) of it in the right chart at the mean, order [ω, v].
        columns: (T,) each, the system's columns by name; they are attributes too.
        seconds: (T,) time of the frame without decoding;  seconds_waiting: (T,) until the decoded image was there.
        searches: what was looked for, frame by frame.
        problems: what was wrong with single frames, in words.
        relocalisations: numbers of the frames in which it was found again.
        failure: why it ended before the last frame, in words; None where it did not.
    """

    sequence: ImageSequence
    config: MonoConfig
    known: KnownPixels | None
    mapped: KnownMap | None
    slam: MonoSlam
    stamps_ns: np.ndarray
    world_from_camera: np.ndarray
    cov: np.ndarray
    columns: dict[str, np.ndarray]
    searches: list[SearchRecord] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    relocalisations: list[int] = field(default_factory=list)
    failure: str | None = None

    def __getattr__(self, name: str) -> np.ndarray:
        """A column."""
        columns = self.__dict__.get("columns", {})
        if name not in columns:
            raise AttributeError(name)
        return np.asarray(columns[name])

    @property
    def filter(self) -> Filter:
        """The system's filter."""
        return self.slam.filter

    @property
    def sensor(self) -> ImageSensor:
        """The system's image sensor."""
        return self.slam.sensor

    @property
    def given(self) -> int:
        """Number of landmarks that were known from the start: the first rows of the sensor's table."""
        points = self.slam.known_points
        return 0 if points is None else int(points.names.size)

    def measured(self) -> list[FeatureFrame]:
        """What the filter used in each frame, and what started features; names are rows of the sensor's table.

        Of a frame in which too little agreed to be trusted nothing was used, and nothing is reported.
        """
        out, noise = [], self.config.search.noise_px**2 * np.eye(2)
        for stamp, used, one in zip(self.stamps_ns.tolist(), self.found.tolist(), self.searches, strict=True):
            kept = one.found & bool(used)
            names = np.concatenate([one.features[kept], one.started])
            px = np.concatenate([one.px[kept], one.started_px])
            out.append(FeatureFrame(stamp, names, px, np.tile(noise, (names.size, 1, 1))))
        return out

    def save(self, path: Path) -> None:
        """Writes a checkpoint."""
        done = len(self.searches)
        arrays = {f"progress/{name}": column[:done] for name, column in self.columns.items()}
        arrays |= {
            "progress/world_from_camera": self.world_from_camera[:done],
            "progress/cov": self.cov[:done],
            "progress/stamps_ns": self.stamps_ns,
            "progress/problems": np.array(self.problems, dtype=np.str_),
            "progress/relocalisations": np.array(self.relocalisations, dtype=np.int64),
            "searches/counts": np.array([[s.features.size, s.started.size] for s in self.searches]),
        }
        for item in fields(SearchRecord):
            arrays[f"searches/{item.name}"] = np.concatenate([getattr(s, item.name) for s in self.searches])
        self.slam.save(path, arrays)

    def restore(self, path: Path) -> None:
        """The inverse of `save`.

        Raises:
            InputError: the file is damaged, or belongs to a run over another sequence or with other settings.
        """
        arrays = self.slam.load(path)
        if not np.array_equal(arrays.get("progress/stamps_ns", ()), self.stamps_ns):
            raise InputError(f"{path} belongs to a run over another sequence: start without --resume")
        with fitting(path):
            counts = arrays["searches/counts"]
            done = len(counts)
            self.world_from_camera[:done] = arrays["progress/world_from_camera"]
            self.cov[:done] = arrays["progress/cov"]
            for name, column in self.columns.items():
                column[:done] = arrays[f"progress/{name}"]
            self.problems = checked(arrays, "progress/problems", (None,), "U").tolist()
            self.relocalisations = checked(arrays, "progress/relocalisations", (None,), "i").tolist()
            looked_for, started = np.cumsum(counts, axis=0)[:-1].T
            parts = [
                np.split(
                    arrays[f"searches/{item.name}"],
                    started if item.name.startswith("started") else looked_for,
                )
                for item in fields(SearchRecord)
            ]
            self.searches = [SearchRecord(*each) for each in zip(*parts, strict=True)]


def run_images(
    sequence: ImageSequence,
    config: MonoConfig,
    known: KnownPixels | None = None,
    on_frame: Callable[[int, ImageFrame, VideoRun], None] | None = None,
    checkpoint: Path | None = None,
    resume: bool = False,
    mapped: KnownMap | None = None,
) -> VideoRun:
    """Filters a whole sequence.

    What was computed before a frame that cannot be filtered is kept: the run is then shorter and has a `failure`.

    Args:
        sequence: of images.
        config: all settings.
        known: points of known position that are seen in the first image; without them the scale is arbitrary.
        on_frame: called after each frame; a KeyboardInterrupt from it leaves a checkpoint behind.
        checkpoint: file of checkpoints; None writes none.
        resume: go on from the checkpoint, if there is one.
        mapped: a map that the camera is to be found in, in place of making one; it is not changed.

    Raises:
        InputError: the first image cannot be read, the known points do not determine the camera, or the checkpoint
            is of another run.
    """
    if mapped is None:
        first_image(sequence)
    slam = MonoSlam(sequence.camera, config, known, mapped)
    total = len(sequence)
    columns = {name: np.zeros(total) for name in (*_PER_FRAME, "seconds", "seconds_waiting")}
    stamps = np.asarray(sequence.stamps_ns, dtype=np.int64)
    paths = np.zeros((total, 7)), np.zeros((total, 6, 6))
    run = VideoRun(sequence, config, known, mapped, slam, stamps, *paths, columns)
    if resume and checkpoint is not None and checkpoint.exists():
        run.restore(checkpoint)
    waited = time.perf_counter()
    done = len(run.searches)
    frames: Iterator[ImageFrame] = sequence.frames(done) if done < total else iter(())
    for t, frame in enumerate(frames, done):
        started = time.perf_counter()
        columns["seconds_waiting"][t] = started - waited
        try:
            tracked = slam.take(frame)
            if not slam.filter.steps:
                raise InputError(
                    f"{sequence.name}: the first image is needed to start: {tracked.messages[0]}"
                )
        except InputError as error:
            if t == 0:
                raise
            run.failure = f"frame {t} of {sequence.name}: {error}"
            break
        columns["seconds"][t] = time.perf_counter() - started
        run.world_from_camera[t], run.cov[t] = tracked.pose, tracked.cov
        if tracked.revision is not None:
            run.world_from_camera[: t + 1] = tracked.revision.poses
            run.cov[: t + 1] = tracked.revision.covs
        for name in _PER_FRAME:
            columns[name][t] = tracked.values[name]
        run.searches.append(SearchRecord(**tracked.observed))
        run.problems += [f"frame {t}: {words}" for words in tracked.messages]
        if tracked.values["relocalised"]:
            run.relocalisations.append(t)
        if checkpoint is not None and (t + 1) % config.checkpoint_every == 0:
            _keep(run, checkpoint)
        try:
            if on_frame is not None:
                on_frame(t, frame, run)
        except KeyboardInterrupt:
            if checkpoint is not None:
                _keep(run, checkpoint)
            raise
        waited = time.perf_counter()
    if checkpoint is not None and run.failure is None:
        _keep(run, checkpoint)
    # A video may end before its last announced image.
    done = len(run.searches)
    run.stamps_ns, run.world_from_camera, run.cov = (
        array[:done] for array in (run.stamps_ns, run.world_from_camera, run.cov)
    )
    for name in columns:
        columns[name] = columns[name][:done]
    return run


def first_image(sequence: ImageSequence) -> np.ndarray:
    """The image (H, W) that a run starts from.

    Raises:
        InputError: it cannot be read.
    """
    first = next(sequence.frames(), None)
    if first is None or first.image is None:
        reason = "it has no image" if first is None else first.problem
        raise InputError(f"{sequence.name}: the first image is needed to start: {reason}")
    return first.image


def _keep(run: VideoRun, checkpoint: Path) -> None:
    """Writes a checkpoint; where the disk is full the run goes on all the same, and the last one stays."""
    try:
        run.save(checkpoint)
    except InputError as error:
        run.problems.append(f"frame {len(run.searches) - 1}: no checkpoint is kept: {error}")
