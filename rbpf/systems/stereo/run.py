"""Runs stereo SLAM over a recording: odometry from pair to pair, and the filter where the camera has moved enough."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.filter import Filter, StepReport
from rbpf.core.particles import Estimate
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_motions import Known
from rbpf.sensors.feature_log import CameraTruth, FeatureLog
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.stereo.config import StereoConfig, TriggerConfig
from rbpf.systems.stereo.dead_reckoning import DeadReckoning, Reckoned, chained
from rbpf.systems.stereo.delayed_update import motion_for_update
from rbpf.systems.stereo.feature_cache import CachedSequence
from rbpf.systems.stereo.front_ends import FrontEnd, ImageFrontEnd
from rbpf.systems.stereo.name_front_end import NameFrontEnd
from rbpf.systems.stereo.resuming import cut, restore, save
from rbpf.systems.stereo.seen import Seen
from rbpf.systems.stereo.system import build_filter, build_reckoning


@dataclass
class StereoRun:
    """A run over T pairs.

    Attributes:
        name: of the recording.
        truth: where the camera really was; None where unknown.
        config: with what settings.
        front_end: what measures the pairs.
        reckoning: what chains them.
        filter: in its final state.
        stamps_ns: (T,).
        world_from_camera: (T, 7) online: filtered mean at the last update, moved on by odometry.
        cov: (T, 6, 6) of it in the right chart at the mean, order [ω, v].
        odometry: (T, 7) world_from_camera by odometry alone.
        features: (T,) of each pair;  agreeing: (T,) matches that agree with the motion since the last pair.
        assumed: (T,) pairs since the place was known last over which the motion was only assumed; 0 where it is known.
        updated: (T,) whether the filter was updated;  observed: (T,) landmarks seen then.
        ess: (T,) effective sample size before resampling, 0 without an update;  resampled: (T,).
        log_evidence: (T,) increments, NaN where the likelihood is no density.
        nis: (T,) normalised innovation squared;  nis_dof: (T,) its degrees of freedom.
        seconds: (T,) time of the whole pair without decoding;  seconds_features: (T,) of measuring it;
            seconds_odometry: (T,) of matching with the last one and estimating the motion.
        seconds_matching: (T,) of finding landmarks;  seconds_filter: (T,) of the rest of the update.
        notes: what was wrong with single pairs, in words.
        failure: why it ended before the last pair, in words; None where it did not.
        per_stamp: nanoseconds per unit of `stamps_ns`: 1, or 10⁹ where stamps count pairs of unknown time.
        frames_done: pairs so far.
        last_update: pair at which the filter was updated last.
        at_update: its estimate then.
        seen: what each pair showed.
    """

    name: str
    truth: CameraTruth | None
    config: StereoConfig
    front_end: FrontEnd
    reckoning: DeadReckoning
    filter: Filter
    stamps_ns: np.ndarray
    world_from_camera: np.ndarray
    cov: np.ndarray
    odometry: np.ndarray
    features: np.ndarray
    agreeing: np.ndarray
    assumed: np.ndarray
    updated: np.ndarray
    observed: np.ndarray
    ess: np.ndarray
    resampled: np.ndarray
    log_evidence: np.ndarray
    nis: np.ndarray
    nis_dof: np.ndarray
    seconds: np.ndarray
    seconds_features: np.ndarray
    seconds_odometry: np.ndarray
    seconds_matching: np.ndarray
    seconds_filter: np.ndarray
    notes: list[str] = field(default_factory=list)
    failure: str | None = None
    per_stamp: int = 1
    frames_done: int = 0
    last_update: int = 0
    at_update: Estimate = field(default_factory=lambda: Estimate(SE3.identity(), np.zeros((6, 6))))
    seen: Seen = field(default_factory=Seen)


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
    front_end = ImageFrontEnd(sequence.rig, config)
    stamps = np.asarray(sequence.stamps_ns, dtype=np.int64)
    run = _begin(sequence.name, sequence.truth, config, front_end, stamps)
    if resume and checkpoint is not None and checkpoint.exists():
        restore(run, checkpoint)
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
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    run = _begin(log.name, log.truth, config, NameFrontEnd(log, config), stamps)
    if np.array_equal(stamps, np.arange(stamps.size)):
        run.per_stamp = 1_000_000_000
    if resume and checkpoint is not None and checkpoint.exists():
        restore(run, checkpoint)
    return _all(run, iter(log.frames[run.frames_done :]), on_frame, checkpoint)


def _begin(
    name: str, truth: CameraTruth | None, config: StereoConfig, front_end: FrontEnd, stamps_ns: np.ndarray
) -> StereoRun:
    total = stamps_ns.size
    reckoning, filter_ = build_reckoning(front_end.rig, config), build_filter(front_end.sensor, config)
    poses, covs, odometry = np.zeros((total, 7)), np.zeros((total, 6, 6)), np.zeros((total, 7))
    numbers = np.zeros((15, total))
    return StereoRun(
        name, truth, config, front_end, reckoning, filter_, stamps_ns, poses, covs, odometry, *numbers
    )


def _all(
    run: StereoRun,
    frames: Iterator[Any],
    on_frame: Callable[[int, StereoRun], None] | None,
    checkpoint: Path | None,
) -> StereoRun:
    for t, frame in enumerate(frames, run.frames_done):
        try:
            _frame(run, t, frame)
        except InputError as error:
            if t == 0:
                raise
            run.failure = f"pair {t} of {run.name}: {error}"
            break
        run.frames_done = t + 1
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
    cut(run)
    return run


def _keep(run: StereoRun, checkpoint: Path) -> None:
    """Writes a checkpoint; where the disk is full the run goes on all the same, and the last one stays."""
    try:
        save(run, checkpoint)
    except InputError as error:
        run.notes.append(f"pair {run.frames_done - 1}: no checkpoint is kept: {error}")


def _frame(run: StereoRun, t: int, frame: Any) -> None:
    started = time.perf_counter()
    count, problem = run.front_end.look(frame)
    run.features[t], run.seconds_features[t] = count, time.perf_counter() - started
    at, whole = _reckon(run, t, problem)
    run.agreeing[t], run.odometry[t] = at.agreeing, at.world_from_camera
    run.seconds_odometry[t] = time.perf_counter() - started - run.seconds_features[t]
    if whole and (
        run.filter.steps == 0 or triggered(at.since_update, run.config.trigger, t - run.last_update)
    ):
        motion = motion_for_update(run, t, at)
        if motion is not None:
            _update(run, t, motion, run.config.recovery.used and at.assumed > 0)
    run.assumed[t] = 0 if run.updated[t] and run.config.recovery.used else at.assumed
    if whole:
        run.front_end.note(t, at.agree, bool(run.updated[t]))
    estimate = moved_on(run.at_update, at.since_update) if not run.updated[t] else run.at_update
    run.world_from_camera[t], run.cov[t] = estimate.mean, estimate.cov
    run.seconds[t] = time.perf_counter() - started
    run.seen.record(*run.front_end.seen(bool(run.updated[t])))


def _reckon(run: StereoRun, t: int, problem: str) -> tuple[Reckoned, bool]:
    """The motion up to pair t, and whether the pair could be measured."""
    stamp, reckoning = run.per_stamp * int(run.stamps_ns[t]), run.reckoning
    least, count = run.config.odometry.estimate.least_matches, int(run.features[t])
    is_later = reckoning.is_later(stamp)
    if count < least or not is_later:
        few = (
            f"it shows {count} features, {least} are needed"
            if is_later
            else "it has the stamp of the last one"
        )
        what = f"{problem}; {few}" if problem and count else problem or few
        run.notes.append(f"pair {t} is passed over: {what}; the last velocity is assumed, widely")
        return reckoning.assumed(stamp), False
    if problem:
        run.notes.append(f"pair {t}: {problem}")
    if not reckoning.begun:
        at = reckoning.begin(stamp)
    else:
        rng = np.random.default_rng([run.config.seed, t])
        matches = run.front_end.matches()
        known = Known(partial(_log_support, run, t), run.front_end.segmentation.before())
        at = reckoning.measured(stamp, matches, rng, known)
        run.front_end.segmentation.leave_out(at.moving)
        if at.note:
            run.notes.append(f"pair {t}: {at.note}")
    run.front_end.keep()
    return at, True


def _log_support(run: StereoRun, t: int, since_update: Odometry) -> float:
    """What the map says of a motion up to pair t."""
    if not run.filter.steps:
        return 0.0
    belief = run.filter.expect(since_update, int(run.stamps_ns[t]))
    return run.front_end.log_support(belief, run.reckoning.in_doubt)


def triggered(motion: Odometry, config: TriggerConfig, frames: int) -> bool:
    """Whether the camera has moved enough for an update: root mean square, so that doubt counts as motion."""
    variance = np.diagonal(motion.cov)
    turned, moved = SE3.log(motion.delta)[:3], SE3.translation(motion.delta)
    far = float(moved @ moved + variance[3:].sum()) >= config.moved_m**2
    turned_far = float(turned @ turned + variance[:3].sum()) >= config.turned_rad**2
    return far or turned_far or (config.frames > 0 and frames >= config.frames)


def _update(run: StereoRun, t: int, motion: Odometry, doubt: bool) -> None:
    started = time.perf_counter()
    control = motion if run.filter.steps else None
    proposal = run.config.recovery.proposal.build() if doubt else None
    report = run.filter.step(run.front_end.for_filter(doubt), control, int(run.stamps_ns[t]), proposal)
    run.reckoning.updated()
    run.at_update = Estimate(report.estimate.mean, report.estimate.cov)
    run.last_update = t
    elapsed = time.perf_counter() - started
    run.seconds_matching[t] = run.front_end.seconds()
    run.seconds_filter[t] = elapsed - run.seconds_matching[t]
    _note_update(run, t, report)


def _note_update(run: StereoRun, t: int, report: StepReport) -> None:
    run.updated[t], run.observed[t] = True, run.front_end.observed(report)
    run.ess[t], run.resampled[t], run.log_evidence[t] = report.ess, report.resampled, report.log_evidence
    run.nis[t], run.nis_dof[t] = report.nis, report.rows


def moved_on(at: Estimate, motion: Odometry) -> Estimate:
    """An estimate after a further motion."""
    moved = chained(Odometry(at.mean, at.cov), motion)
    return Estimate(moved.delta, moved.cov)
