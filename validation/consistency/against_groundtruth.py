"""A run against the ground truth of its recording: errors, and whether they are as large as the filter says."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.runs.reading import FilteredPath, RunFolder
from rbpf.runs.trajectory import associate, in_space, read_tum
from rbpf.runs.truth import RunTruth
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.consistency.comparison import Comparison
from rbpf.validation.consistency.statistic import (
    STATE_FACTOR,
    Statistic,
    WhitenedErrors,
    coverage,
    degrees_of_freedom,
    variance_ratio,
    whitened_errors,
)
from rbpf.validation.metrics.accuracy import AbsoluteError, ate, rpe

NAME = "groundtruth"
NEES = "poses against the truth"
LEAST = 3
"""Steps with a true pose that a comparison needs."""

_HOW = {
    "none": "without any alignment",
    "rigid": "after a rigid alignment",
    "similarity": "after an alignment with scale (the recording's own scale is arbitrary)",
}


@dataclass(frozen=True)
class TruthErrors:
    """A run beside the truth.

    Attributes:
        path: filtered poses.
        truth: at the steps `truth.rows`.
        positions: errors of the aligned positions.
        whitened: errors of the poses in units of the filter's own; None where they are not in one world.
        landmarks: the map's points whose true places are known, with (M, D) errors; None likewise.
    """

    path: FilteredPath
    truth: RunTruth
    positions: AbsoluteError
    whitened: WhitenedErrors | None
    landmarks: "LandmarkErrors | None"


@dataclass(frozen=True)
class LandmarkErrors:
    """Landmarks in units of the filter's own deviations.

    Attributes:
        map: M landmarks of the run.
        errors: (M, D) from the truth, m.
        squares: (M,) normalised squared errors; a consistent filter's are χ² of D.
    """

    map: MapEstimate
    errors: np.ndarray
    squares: np.ndarray


def truth_errors(record: RunFolder, std_m: float = 0.0, std_rad: float = 0.0) -> TruthErrors:
    """Errors of a run.

    Args:
        record: the run.
        std_m: standard deviation of the true positions themselves, per axis.
        std_rad: likewise of the true rotations.

    Raises:
        InputError: the run has no truth, or too little.
    """
    path, truth = record.path, record.truth
    if truth.rows.size < LEAST:
        raise InputError(
            f"{record.folder}: {truth.rows.size} steps of the run have a true pose, a comparison needs {LEAST}"
        )
    reference = in_space(path.stamps_ns[truth.rows], truth.poses)
    positions = ate(path.trajectory(truth.rows), reference, truth.alignment)
    whitened = landmarks = None
    if truth.alignment == "none":
        turns = 1 if path.space.dim == SE2.dim else 3
        own = np.repeat([std_rad**2, std_m**2], [turns, path.space.dim - turns])
        cov = path.cov[truth.rows] + np.diag(own)
        whitened = whitened_errors(path.space, path.mean[truth.rows], cov, truth.poses)
        landmarks = _landmark_errors(record.map.points(), truth)
    return TruthErrors(path, truth, positions, whitened, landmarks)


def pose_statistics(errors: WhitenedErrors) -> list[Statistic]:
    """NEES of the poses and coverage of their credible regions; none where all poses are held to be exact."""
    known = errors.ranks > 0
    if not known.any():
        return []
    dim = errors.errors.shape[1]
    dof, nees = degrees_of_freedom(errors.errors[known]), errors.nees[known]
    ratio = variance_ratio(NEES, float(nees.sum() / errors.ranks[known].sum()), dof, STATE_FACTOR)
    full = errors.ranks[known] == dim
    return [ratio, *(coverage(nees[full], dim, max(dof / dim, 1.0)) if full.any() else [])]


def compare_with_truth(record: RunFolder, errors: TruthErrors) -> Comparison:
    """The comparison of a run with the truth, from its `truth_errors`."""
    path, truth, at = errors.path, errors.truth, errors.positions
    reference = in_space(path.stamps_ns[truth.rows], truth.poses)
    accuracy = (
        f"The path is {_metres(at.rmse)} (rms) from the truth, {_metres(at.max)} at worst, over {at.keys.size} of "
        f"{len(path.mean)} steps {_HOW[truth.alignment]}"
    )
    relative = rpe(path.trajectory(truth.rows), reference, alignment=at.alignment)
    figures: dict[str, Any] = {
        "alignment": truth.alignment,
        "steps_compared": int(truth.rows.size),
        "position_rmse_m": at.rmse,
        "position_max_m": at.max,
        "motion_translation_rmse_m": relative.translation_rmse,
        "motion_rotation_rmse_deg": relative.rotation_rmse_deg,
    }
    if errors.whitened is not None:
        nees, known = errors.whitened.nees, errors.whitened.ranks > 0
        figures |= {
            "pose_nees_mean": float(nees[known].mean()) if known.any() else 0.0,
            "pose_nees_median": float(np.median(nees[known])) if known.any() else 0.0,
            "pose_nees_right": float(errors.whitened.ranks[known].mean()) if known.any() else 0.0,
        }
    if errors.landmarks is not None:
        figures |= {
            "landmarks_compared": int(errors.landmarks.squares.size),
            "landmark_rmse_m": float(np.sqrt(np.square(errors.landmarks.errors).sum(axis=1).mean())),
            "landmark_nees_mean": float(errors.landmarks.squares.mean()),
            "landmark_nees_right": float(errors.landmarks.errors.shape[1]),
        }
    # The batch optimum's positions at the same steps, aligned in the same way, where the run has one.
    if (record.folder / "batch.tum").is_file():
        batch, beside = associate(read_tum(record.folder / "batch.tum"), reference, 0)
        rmse = ate(batch, beside, truth.alignment).rmse
        figures["batch_position_rmse_m"] = rmse
        accuracy += f"; the batch optimum of the same measurements is {_metres(rmse)} from it"
    statistics = [] if errors.whitened is None else pose_statistics(errors.whitened)
    return Comparison(NAME, f"{accuracy}.", figures, statistics)


def _landmark_errors(found: MapEstimate, truth: RunTruth) -> LandmarkErrors | None:
    kept = np.array([name in truth.landmarks for name in found.ids.tolist()], dtype=bool)
    if not kept.any():
        return None
    found = MapEstimate(found.ids[kept], found.mean[kept], found.cov[kept])
    true = np.array([truth.landmarks[name] for name in found.ids.tolist()])
    error = true - found.mean
    squares = np.einsum("md,mde,me->m", error, np.linalg.pinv(found.cov, hermitian=True), error)
    return LandmarkErrors(found, error, squares)


def _metres(value: float) -> str:
    return f"{1e3 * value:.2g} mm" if value < 0.0995 else f"{value:.2f} m"
