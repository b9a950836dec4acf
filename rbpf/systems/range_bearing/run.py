"""Runs the filter over a log, with checkpoints, and gathers what the run is judged by."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from rbpf.core.anchoring import Anchored, StartAnchor
from rbpf.core.checkpoint import fitting
from rbpf.core.diagnostics import motion_correction
from rbpf.core.estimate import Estimate
from rbpf.core.filter import Filter, StepReport
from rbpf.errors import InputError
from rbpf.sensors.readers.log import RobotLog
from rbpf.systems.range_bearing.associations import Associations, named_associations
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.system import build_filter, build_model, build_point, control_of

CHECKPOINT = "checkpoint.npz"


@dataclass
class Progress:
    """One row per step done: what a checkpoint must hold besides the filter.

    Attributes:
        mean: (T, E) online filtered mean.
        cov: (T, d, d) in the right chart at the mean.
        ess: (T,) effective sample size before resampling.
        resampled: (T,) bool.
        log_evidence: (T,) increments.
        nis: (T,) normalised innovation squared.
        rows: (T,) its degrees of freedom.
        seconds: (T,) time of the step.
        correction: (T, d) what the observations say about the motion, in its own whitened coordinates; NaN where the
            proposal did not ask them.
        cov_correction: (T, d, d) what an honest filter expects of it; see `rbpf.core.diagnostics.Correction`.
    """

    mean: np.ndarray
    cov: np.ndarray
    ess: np.ndarray
    resampled: np.ndarray
    log_evidence: np.ndarray
    nis: np.ndarray
    rows: np.ndarray
    seconds: np.ndarray
    correction: np.ndarray
    cov_correction: np.ndarray

    @classmethod
    def empty(cls, steps: int, size: int, dim: int) -> "Progress":
        """Room for a run."""
        names = ("ess", "resampled", "log_evidence", "nis", "rows", "seconds")
        numbers = {name: np.zeros(steps) for name in names}
        poses, covs = np.zeros((steps, size)), np.zeros((steps, dim, dim))
        unknown, none = np.full((steps, dim), np.nan), np.full((steps, dim, dim), np.nan)
        return cls(mean=poses, cov=covs, correction=unknown, cov_correction=none, **numbers)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {f"progress/{item.name}": getattr(self, item.name) for item in fields(self)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, for a log of the same length.

        Raises:
            InputError: the checkpoint belongs to another log.
        """
        for item in fields(self):
            stored = arrays.get(f"progress/{item.name}")
            if stored is None or stored.shape != getattr(self, item.name).shape:
                raise InputError("the checkpoint belongs to a run over another log: start without --resume")
            getattr(self, item.name)[...] = stored

    def put(self, t: int, report: StepReport, estimate: Estimate, seconds: float) -> None:
        """Row t."""
        self.mean[t], self.cov[t] = estimate.mean, estimate.cov
        self.ess[t], self.resampled[t], self.log_evidence[t] = (
            report.ess,
            report.resampled,
            report.log_evidence,
        )
        self.nis[t], self.rows[t], self.seconds[t] = report.nis, report.rows, seconds
        correction = motion_correction(report.mixture)
        if correction is not None:
            self.correction[t], self.cov_correction[t] = correction.mean, correction.cov


@dataclass
class Run:
    """A finished run.

    Attributes:
        log: what was filtered.
        config: with what settings.
        filter: in its final state.
        progress: one row per step.
        associations: per step, the landmark of each sighting, −1 where it was not used: the log's name where the
            association is known, else the map's id along the ancestors of the best particle.
        anchored: the start in each particle's world, which the map is relative to; None where it is not re-estimated.
        problems: what went wrong on the way, in words.
    """

    log: RobotLog
    config: RangeBearingConfig
    filter: Filter
    progress: Progress
    associations: list[np.ndarray]
    anchored: Anchored | None
    problems: list[str] = field(default_factory=list)


def run(
    log: RobotLog,
    config: RangeBearingConfig,
    out: Path | None = None,
    resume: bool = False,
    on_step: Callable[[int, int], None] | None = None,
) -> Run:
    """Filters a whole log.

    Args:
        log: the recording.
        config: all settings.
        out: folder for checkpoints; None writes none.
        resume: go on from the checkpoint in `out`, if there is one.
        on_step: called with the steps done and their number; a KeyboardInterrupt from it leaves a checkpoint behind.

    Raises:
        InputError: the log or a setting does not fit, or no particle explains the observations.
    """
    filter_ = build_filter(log, config)
    total = len(log.frames)
    progress = Progress.empty(total, log.space.size, log.space.dim)
    associations = Associations(filter_)
    anchor = StartAnchor(filter_, config.anchor_every) if config.anchor_every else None
    checkpoint = None if out is None else out / CHECKPOINT
    problems: list[str] = []
    if resume and checkpoint is not None and checkpoint.exists():
        extra = filter_.load(checkpoint)
        with fitting(checkpoint):
            progress.restore(extra)
            associations.restore(extra)
            if anchor is not None:
                anchor.restore(extra, build_model(log, config), build_point(log))

    def save() -> None:
        if checkpoint is None:
            return
        kept = {} if anchor is None else anchor.arrays()
        try:
            filter_.save(checkpoint, progress.arrays() | associations.arrays() | kept)
        except InputError as error:
            # On a full disk the run goes on all the same, and the last checkpoint stays.
            problems.append(f"step {filter_.steps - 1}: no checkpoint is kept: {error}")

    for t in range(filter_.steps, total):
        frame = log.frames[t]
        started = time.perf_counter()
        control = control_of(frame)
        report = filter_.step(frame, control, frame.stamp_ns)
        estimate = report.estimate
        if anchor is not None:
            estimate = anchor.state_estimate(anchor.after_step(report, control))
        progress.put(t, report, estimate, time.perf_counter() - started)
        associations.record(report, frame.z.shape[0])
        if filter_.steps % config.checkpoint_every == 0 or t + 1 == total:
            save()
        try:
            if on_step is not None:
                on_step(t + 1, total)
        except KeyboardInterrupt:
            save()
            raise
    used = named_associations(log)
    if config.association == "ml":
        used = associations.of(filter_.belief().mode)
    anchored = None if anchor is None else anchor.estimate()
    return Run(log, config, filter_, progress, used, anchored, problems)
