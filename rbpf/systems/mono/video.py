"""Runs monocular SLAM over a sequence of images: search, filter, loss and recovery."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.readers.images import ImageFrame, ImageSequence, KnownPixels
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.known_map import KnownMap
from rbpf.systems.mono.known_start import KnownStart, located_points, require_texture
from rbpf.systems.mono.recovery import Recovery
from rbpf.systems.mono.resuming import cut, restore, save
from rbpf.systems.mono.run import estimate_in, told_anew
from rbpf.systems.mono.sightings import Sightings
from rbpf.systems.mono.system import assemble, build_features, start_cov, start_std, world_of
from rbpf.systems.mono.unknown_start import TORN, UnknownStart


@dataclass
class VideoRun:
    """A run over T images.

    Attributes:
        sequence: what was filtered.
        config: with what settings.
        known: the known points, None where it started without any.
        mapped: the map that the camera is found in, and that is not changed; None where the run makes its own.
        filter: in its final state.
        sensor: its image sensor.
        stamps_ns: (T,).
        world_from_camera: (T, 7) online filtered mean, in the world of the known points, else of the first camera; the
            frames of a start without known points are told anew at its end, when there is a scale to tell them in.
        cov: (T, 6, 6) of it in the right chart at the mean, order [ω, v].
        searched: (T,) landmarks looked for.
        found: (T,) landmarks found.
        lost: (T,) whether the camera was lost after the frame.
        ess: (T,) effective sample size before resampling.
        log_evidence: (T,) increments.
        resampled: (T,) whether the particles were resampled.
        nis: (T,) normalised innovation squared;  nis_dof: (T,) its degrees of freedom.
        seconds: (T,) time of the whole frame without decoding;  seconds_search: (T,) of the search in the image.
        seconds_waiting: (T,) until the decoded image was there.
        seconds_new_landmarks: (T,) of judging what was looked for and starting landmarks at corners, part of the frame's.
        seconds_telling: (T,) of the estimate and of taking notes, after the frame's time.
        sightings: what was looked for, frame by frame.
        problems: what was wrong with single frames, in words.
        relocalisations: numbers of the frames in which it was found again.
        failure: why it ended before the last frame, in words; None where it did not.
        recovery: what finds the camera again.
        start: what draws the particles anew while it starts without known points.
    """

    sequence: ImageSequence
    config: MonoConfig
    known: KnownPixels | None
    mapped: KnownMap | None
    filter: Filter
    sensor: ImageSensor
    stamps_ns: np.ndarray
    world_from_camera: np.ndarray
    cov: np.ndarray
    searched: np.ndarray
    found: np.ndarray
    lost: np.ndarray
    ess: np.ndarray
    log_evidence: np.ndarray
    resampled: np.ndarray
    nis: np.ndarray
    nis_dof: np.ndarray
    seconds: np.ndarray
    seconds_search: np.ndarray
    seconds_waiting: np.ndarray
    seconds_new_landmarks: np.ndarray
    seconds_telling: np.ndarray
    sightings: Sightings = field(init=False)
    problems: list[str] = field(default_factory=list)
    relocalisations: list[int] = field(default_factory=list)
    failure: str | None = None
    recovery: Recovery = field(init=False)
    start: UnknownStart = field(init=False)

    def __post_init__(self) -> None:
        """Watches over the sensor from the start."""
        found, std = self.mapped, start_std(self.config.velocity)
        views, size = (None, 0.0) if found is None else (found.views, found.size_m)
        self.recovery = Recovery(self.sensor, self.config.relocalisation, std, views, size)
        self.sightings = Sightings(0 if found is None else found.names.size)
        self.start = UnknownStart(self.config, needed=found is None and self.known is None)

    @property
    def given(self) -> int:
        """Number of landmarks that were known from the start: the first rows of the sensor's table."""
        if self.mapped is not None:
            return int(self.mapped.names.size)
        return 0 if self.known is None else int(self.known.names.size)


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
        run, law = _begin(sequence, config, known, first_image(sequence))
    else:
        run, law = _begin_in(sequence, config, mapped), None
    if resume and checkpoint is not None and checkpoint.exists():
        restore(run, checkpoint)
    waited = time.perf_counter()
    for t, frame in enumerate(_frames_from(sequence, run.filter.steps), run.filter.steps):
        run.seconds_waiting[t] = time.perf_counter() - waited
        try:
            _frame(run, t, frame, law if t == 0 else _waiting(run))
        except InputError as error:
            if t == 0:
                raise
            run.failure = f"frame {t} of {sequence.name}: {error}"
            break
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
    cut(run)
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


def _frames_from(sequence: ImageSequence, start: int) -> Iterator[ImageFrame]:
    return sequence.frames(start) if start < len(sequence) else iter(())


def _begin(
    sequence: ImageSequence, config: MonoConfig, known: KnownPixels | None, image: np.ndarray
) -> tuple[VideoRun, PosePrior]:
    """A run before its first frame, and where the camera is in it: at the origin, unless the known points tell."""
    start, law = None, PosePrior(SE3.identity(), np.zeros((6, 6)))
    if known is not None:
        points, pose = located_points(sequence.camera, known, config.search.noise_px)
        noise = np.tile(config.search.noise_px**2 * np.eye(2), (known.names.size, 1, 1))
        sight = FeatureFrame(int(sequence.stamps_ns[0]), points.names, known.px, noise)
        start = KnownStart(points, pose, points.names, sight)
        require_texture(image, known)
        if config.known == "points":
            law = PosePrior(pose, start_cov(config))
    features = build_features(sequence.camera, config, start)
    sensor = ImageSensor(features, config.search)
    if known is not None:
        sensor.begin(image, known.px, config.known == "frame")
    return _empty(sequence, config, sensor, assemble(config, features, start, sensor), known), law


def _begin_in(sequence: ImageSequence, config: MonoConfig, mapped: KnownMap) -> VideoRun:
    """A run before its first frame, somewhere in a map."""
    mapped.require_camera(sequence.camera, sequence.name)
    features = build_features(sequence.camera, config, None, fixed=True)
    sensor = ImageSensor(features, config.search)
    sensor.begin_lost(mapped.windows, mapped.first_px, mapped.first_pose, mapped.positions)
    filter_ = assemble(config, features, None, sensor, mapped.points)
    return _empty(sequence, config, sensor, filter_, None, mapped)


def _empty(
    sequence: ImageSequence,
    config: MonoConfig,
    sensor: ImageSensor,
    filter_: Filter,
    known: KnownPixels | None,
    mapped: KnownMap | None = None,
) -> VideoRun:
    total = len(sequence)
    numbers = np.zeros((13, total))
    poses, covs = np.zeros((total, 7)), np.zeros((total, 6, 6))
    stamps = np.asarray(sequence.stamps_ns, dtype=np.int64)
    run = VideoRun(sequence, config, known, mapped, filter_, sensor, stamps, poses, covs, *numbers)
    run.recovery.stamp_ns = int(stamps[0])
    return run


def _keep(run: VideoRun, checkpoint: Path) -> None:
    """Writes a checkpoint; where the disk is full the run goes on all the same, and the last one stays."""
    try:
        save(run, checkpoint)
    except InputError as error:
        run.problems.append(f"frame {run.filter.steps - 1}: no checkpoint is kept: {error}")


def _waiting(run: VideoRun) -> PosePrior | None:
    """The camera stays at the origin until an image shows something; nothing once there are features."""
    if run.sensor.table.count:
        return None
    return PosePrior(SE3.identity(), np.zeros((6, 6)), start_std(run.config.velocity))


def _fitting(run: VideoRun, frame: ImageFrame) -> ImageFrame:
    """The frame, without its image if that is not what the camera takes: readers see to it, other sources may not."""
    camera, image = run.sequence.camera, frame.image
    if image is None or (image.shape == (camera.height, camera.width) and image.dtype == np.uint8):
        return frame
    problem = (
        f"expected {camera.width}x{camera.height} grey levels of 8 bits, got {image.shape} {image.dtype}"
    )
    return replace(frame, image=None, problem=f"the image is not used: {problem}")


def _frame(run: VideoRun, t: int, frame: ImageFrame, law: PosePrior | None) -> None:
    started = time.perf_counter()
    frame = run.recovery.checked(_fitting(run, frame))
    was_lost, never_found = run.sensor.lost, run.recovery.never_found
    law = law or run.recovery.law(frame, run.filter)
    report = run.filter.step(frame, law, frame.stamp_ns)
    run.recovery.note(frame, run.filter)
    run.seconds[t], world = time.perf_counter() - started, world_of(run.filter)
    estimate = estimate_in(world, run.filter, report)
    run.world_from_camera[t], run.cov[t] = estimate.mean, estimate.cov + run.recovery.drift(frame)
    searched = run.sensor.searched
    run.searched[t], run.found[t] = searched.rows.size, run.sensor.measured.landmarks.size
    run.lost[t] = run.sensor.lost
    run.ess[t], run.log_evidence[t] = report.ess, report.log_evidence
    run.resampled[t], run.nis[t], run.nis_dof[t] = report.resampled, report.nis, report.rows
    run.seconds_search[t], run.seconds_new_landmarks[t] = run.sensor.seconds, run.sensor.seconds_new_landmarks
    run.sightings.record(run.sensor, run.filter, world)
    run.seconds_telling[t] = time.perf_counter() - started - run.seconds[t]
    if run.start.due(t + 1, run.sensor.lost and run.sensor.table.count > 0) and not run.sensor.bad_frames:
        _redraw(run, t, frame)
    if frame.problem is not None:
        run.problems.append(f"frame {t}: {frame.problem}")
    if run.sensor.lost and not was_lost:
        run.problems.append(f"frame {t}: the camera is lost, its pose is held until the map is seen again")
    if never_found and not run.sensor.lost:
        run.problems.append(f"frame {t}: the camera is found in the map")
    elif was_lost and not run.sensor.lost:
        run.problems.append(f"frame {t}: the camera is found again")
        run.relocalisations.append(t)


def _redraw(run: VideoRun, t: int, frame: ImageFrame) -> None:
    """Draws the particles of a start without known points anew."""
    started = time.perf_counter()
    done = slice(t + 1)
    measured = run.sightings.measured(run.stamps_ns[done], run.found[done], run.config.search.noise_px)
    drawn = run.start.redrawn(run.filter, run.sensor.features, measured, run.world_from_camera[done])
    if drawn is not None:
        run.filter = drawn[0]
        run.world_from_camera[done], run.cov[done] = told_anew(drawn[1])
        belief, counts = run.filter.belief(), [seen.started.shape[0] for seen in run.sightings.frames]
        run.sensor.drawn_anew(belief, drawn[1][:, belief.mode], np.repeat(np.arange(t + 1), counts))
        run.recovery.note(frame, run.filter)
    elif run.start.over:
        run.problems.append(f"frame {t}: {TORN}")
    run.seconds[t] += time.perf_counter() - started
