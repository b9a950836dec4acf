"""The score table of a run of any system, from its folder: errors against the truth, and distance from the batch.

Every frame counts, including those in which the system was lost. All errors are in the world of the run's report, together
with its truth (`rbpf.runs.truth`): without alignment if both are in one world, else after a rigid or a similarity
alignment. A further figure of merit of all runs is one function from a path to entries, entered into `MERITS`.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from rbpf.errors import InputError
from rbpf.runs.files import BATCH, ODOMETRY
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import Trajectory, align, associate, fit, in_space, read_tum
from rbpf.runs.truth import LEAST, TRUTH, RunTruth
from rbpf.validation.metrics.accuracy import ate, landmark_errors, rpe

#: Prefix of the odometry's figures, by system; by default `odometry_`.
ODOMETRY_PREFIX = {"stereo": "vo_"}


def absolute_errors(estimate: Trajectory, reference: Trajectory, truth: RunTruth) -> dict[str, float]:
    """Positions in the world of the report, after rigid and after similarity alignment."""
    similar, reported = ate(estimate, reference, "similarity"), ate(estimate, reference, truth.alignment).rmse
    own = {"path_rmse_m": reported} if truth.alignment == "none" else {}
    return {
        "position_rmse_m": reported,
        "ate_rmse_m": ate(estimate, reference, "rigid").rmse,
        "ate_sim3_rmse_m": similar.rmse,
        "sim3_scale": similar.alignment.scale,
        **own,
    }


def relative_errors(estimate: Trajectory, reference: Trajectory, truth: RunTruth) -> dict[str, float]:
    """Motion from one scored frame to the next; after the similarity alignment if the scale is not measured."""
    relative = rpe(estimate, reference, alignment="similarity" if truth.alignment == "similarity" else "rigid")
    return {
        "rpe_translation_rmse_m": relative.translation_rmse,
        "rpe_rotation_rmse_deg": relative.rotation_rmse_deg,
        "scored_instants": len(reference),
    }


#: Figures of merit of a path: functions of estimate and truth at the same frames, and the alignment.
Merit = Callable[[Trajectory, Trajectory, RunTruth], Mapping[str, float]]
MERITS: tuple[Merit, ...] = (absolute_errors, relative_errors)


def score_run(found: RunFolder) -> dict[str, Any]:
    """Entries of summary.json for the filter, the odometry alone and the batch optimum; none without ground truth.

    Those of the odometry begin with `odometry_` (in a stereo run with `vo_`), those of the optimum with `batch_`.
    """
    if not ((found.folder / TRUTH).is_file() and found.truth.rows.size >= LEAST):
        return {}
    files = {ODOMETRY_PREFIX.get(found.system, "odometry_"): ODOMETRY, "batch_": BATCH}
    there = {prefix: found.folder / name for prefix, name in files.items() if (found.folder / name).is_file()}
    others = {prefix: read_tum(path) for prefix, path in there.items()}
    scores = score_estimate(found.estimate, found.truth, is_anonymous(found), others)
    return {"alignment": found.truth.alignment} | scores


def is_anonymous(found: RunFolder) -> bool:
    """Whether the ids of a run's landmarks are its own, and not the recording's names."""
    return found.config.get("association") == "ml"


def score_estimate(
    estimate: PathAndMap, truth: RunTruth, anonymous: bool = False, others: Mapping[str, Trajectory] | None = None
) -> dict[str, float]:
    """Errors of a path with a pose for every frame, and of its map; `anonymous` landmarks have no names.

    `others` are further paths of the run, by the prefix of their errors' names.
    """
    reference = in_space(estimate.stamps_ns[truth.rows], truth.poses)
    ours = estimate.at(truth.rows).trajectory
    entries = _merits(ours, reference, truth) | score_landmarks(estimate, truth, anonymous)
    for prefix, path in (others or {}).items():
        entries |= score_path(path, reference, truth, prefix)
    return entries


def score_path(path: Trajectory, reference: Trajectory, truth: RunTruth, prefix: str = "") -> dict[str, float]:
    """All figures of merit of a path whose frames are among those of a run; none with too few true poses."""
    try:
        estimate, reference = associate(path, reference, 0)
    except InputError:
        return {}
    entries = _merits(estimate, reference, truth) if len(estimate) >= LEAST else {}
    return {prefix + name: value for name, value in entries.items()}


def _merits(estimate: Trajectory, reference: Trajectory, truth: RunTruth) -> dict[str, float]:
    return {name: value for merit in MERITS for name, value in merit(estimate, reference, truth).items()}


def score_landmarks(estimate: PathAndMap, truth: RunTruth, anonymous: bool = False) -> dict[str, float]:
    """Mean errors of landmarks with known true positions, with the path's alignment, and with their own.

    The estimate has a pose for every frame of the run. Landmarks without the recording's names (`anonymous`) are matched
    one-to-one with the nearest true ones.
    """
    names, points = estimate.landmarks.named(), estimate.landmarks.mean
    if not truth.landmarks or not names:
        return {}
    ours, dim = estimate.at(truth.rows).trajectory, points.shape[1]
    reference = in_space(ours.stamps_ns, truth.poses)
    if anonymous:
        # One-to-one assignment of least total distance. The alignment, at first the path's, and the matching alternate, as in
        # iterated closest points.
        true_names = list(truth.landmarks)
        true = np.array([truth.landmarks[name][:dim] for name in true_names])
        placed = ate(ours, reference, "rigid").alignment.in_dimension(dim).transform(points)
        for _ in range(5):
            rows, columns = linear_sum_assignment(np.linalg.norm(placed[:, None] - true[None], axis=-1))
            placed = align(points[rows], true[columns]).transform(points)
        names = {true_names[column]: points[row] for row, column in zip(rows, columns, strict=True)}
    moved = fit(truth.alignment, ours.positions, reference.positions).in_dimension(dim)
    try:
        own = landmark_errors(names, truth.landmarks, moved)
        aligned = landmark_errors(names, truth.landmarks, "rigid")
    except InputError:  # no landmark is in both
        return {}
    return {"landmark_error_mean_m": own.mean, "landmark_error_aligned_mean_m": aligned.mean}
