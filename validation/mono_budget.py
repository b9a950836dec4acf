"""The error budget of a run over images: the filter again with perfect parts in turn, on the same measurements.

The run's own matches are filtered again without its images. What a perfect part takes away from the error is what the
filter's own part put in. Part by part:

    as it is            the run itself, images and all
    same measurements   its matches, filtered again
    associations        without the matches that the batch shows to be wrong
    depths              landmarks start at the batch's depths
    both                of the two
    particles           ten times as many
    calibration         focal length and k1 as the batch would have them
    batch …             the batch optimum of the same measurements, without wrong matches, with that calibration
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rbpf.runs.alignment import Alignment
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import run as filter_log
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.gtsam.mono_batch import Batch, adjust_run
from rbpf.validation.gtsam.self_calibration import refine_calibration
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.metrics.mono_scores import true_path, usual_alignment
from rbpf.validation.mono_log import feature_log
from rbpf.validation.mono_parts import (
    WRONG_PX,
    GivenDepths,
    adjust_near,
    agreeing_matches,
    batch_depths,
    reprojection_errors,
)

MANY = 10
"""Times as many particles."""

AS_IT_IS, BATCH = "as it is", "batch"


@dataclass(frozen=True)
class Line:
    """One line of the budget.

    Attributes:
        name: of the perfect part.
        frames: (B,) numbers of its frames.
        world_from_camera: (B, 7).
        errors_m: by alignment, over the frames that the reference has.
        distances: (B,) to the reference after the alignment that suits the run; NaN where it has none.
    """

    name: str
    frames: np.ndarray
    world_from_camera: np.ndarray
    errors_m: dict[str, float]
    distances: np.ndarray


@dataclass(frozen=True)
class Budget:
    """All lines, and what they are compared with.

    Attributes:
        against: "ground truth", or "batch" where there is none.
        alignment: the one that suits the run.
        lines: as it is first.
        wrong: fraction of the matches that the batch shows to be wrong.
        calibration: what the batch makes of focal length and k1, in words.
    """

    against: str
    alignment: Alignment
    lines: list[Line]
    wrong: float
    calibration: str

    def error(self, name: str) -> float:
        """Error of a line after the alignment that suits the run [m]."""
        return next(line.errors_m[self.alignment] for line in self.lines if line.name == name)


@dataclass(frozen=True)
class _Reference:
    frames: np.ndarray
    world_from_camera: np.ndarray
    alignment: Alignment

    def line(self, name: str, frames: np.ndarray, poses: np.ndarray) -> Line:
        _, ours, theirs = np.intersect1d(frames, self.frames, return_indices=True)
        estimate, reference = (
            Trajectory(np.arange(ours.size), path) for path in (poses[ours], self.world_from_camera[theirs])
        )
        kinds: tuple[Alignment, ...] = ("none", "rigid", "similarity")
        found = {kind: ate(estimate, reference, kind) for kind in kinds}
        away = np.full(frames.size, np.nan)
        away[ours] = found[self.alignment].distances
        return Line(name, frames, poses, {kind: error.rmse for kind, error in found.items()}, away)


def error_budget(run: VideoRun, told: Callable[[str], None] | None = None) -> Budget:
    """Filters a run's measurements again with perfect parts in turn.

    Args:
        run: finished, its camera never lost.
        told: the name of what is worked on.

    Raises:
        InputError: the batch adjustment fails.
    """
    batch = adjust_run(run)
    log, reference, against = feature_log(run), *_reference(run, batch)
    whole = np.arange(run.stamps_ns.size)
    lines = [
        reference.line(AS_IT_IS, whole, run.world_from_camera),
        reference.line(BATCH, batch.frames, batch.world_from_camera),
    ]
    better = refine_calibration(log, batch)
    for name, work in _parts(log, run, batch, better.camera):
        if told is not None:
            told(name)
        lines.append(reference.line(name, whole, work().world_from_camera))
    clean = adjust_near(agreeing_matches(log, batch), batch)
    lines.append(reference.line("batch, associations", clean.frames, clean.world_from_camera))
    lines.append(reference.line("batch, calibration", better.batch.frames, better.batch.world_from_camera))
    errors = np.concatenate(reprojection_errors(batch))
    errors = errors[np.isfinite(errors)]
    camera = better.camera
    words = (
        f"focal length {run.sequence.camera.fx:.2f} → {camera.fx:.2f} px, "
        f"k1 {run.sequence.camera.distortion[0]:.4f} → {camera.distortion[0]:.4f}"
    )
    return Budget(against, reference.alignment, lines, float((errors > WRONG_PX).mean()), words)


def _parts(
    log: FeatureLog, run: VideoRun, batch: Batch, camera: Any
) -> Iterator[tuple[str, Callable[[], Any]]]:
    config: MonoConfig = run.config
    clean, depths = agreeing_matches(log, batch), batch_depths(batch)
    given = partial(_with_depths, depths=depths)
    many = replace(config, particles=MANY * config.particles)
    yield "same measurements", partial(filter_log, log, config)
    yield "associations", partial(filter_log, clean, config)
    yield "depths", partial(filter_log, log, config, wrapped=given)
    yield "associations and depths", partial(filter_log, clean, config, wrapped=given)
    yield f"{MANY}× particles", partial(filter_log, log, many)
    yield "calibration", partial(filter_log, replace(log, camera=camera), config)


def _with_depths(features: Any, depths: dict[int, float]) -> GivenDepths:
    return GivenDepths(features, depths)


def _reference(run: VideoRun, batch: Batch) -> tuple[_Reference, str]:
    truth = true_path(run.sequence.truth, run.stamps_ns)
    if truth is not None:
        return _Reference(truth.rows, truth.world_from_camera, usual_alignment(run)), "ground truth"
    how: Alignment = "none" if run.known is not None else "similarity"
    return _Reference(batch.frames, batch.world_from_camera, how), "batch"
