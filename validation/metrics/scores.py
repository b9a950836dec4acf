"""The score table of a run of any system, from its folder: errors against the truth, and distance from the batch.

Every frame counts, also those in which the system was lost. All errors are in the world in which the run is reported
beside its truth (`rbpf.runs.truth`): without alignment where both are expressed in one world, after a rigid or a similarity
alignment otherwise. A further figure of merit of all runs is one function from a path to entries, entered into `MERITS`.
"""

from collections.abc import Callable, Mapping
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import Similarity, Trajectory, associate, in_space, read_tum
from rbpf.runs.truth import LEAST, TRUTH, RunTruth
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.metrics.accuracy import ate, landmark_errors, rpe
from rbpf.validation.metrics.matching import match_points

BATCH, ODOMETRY = "batch.tum", "odometry.tum"

ODOMETRY_PREFIX = {"stereo": "vo_"}
"""How the figures of the odometry alone begin, by system; otherwise with `odometry_`."""


def absolute_errors(estimate: Trajectory, reference: Trajectory, truth: RunTruth) -> dict[str, float]:
    """Positions after rigid and after similarity alignment, and without any where one world is shared."""
    similar = ate(estimate, reference, "similarity")
    own = {"path_rmse_m": ate(estimate, reference).rmse} if truth.alignment == "none" else {}
    return {
        "ate_rmse_m": ate(estimate, reference, "rigid").rmse,
        "ate_sim3_rmse_m": similar.rmse,
        "sim3_scale": similar.alignment.scale,
        **own,
    }


def relative_errors(estimate: Trajectory, reference: Trajectory, truth: RunTruth) -> dict[str, float]:
    """Motion from one scored frame to the next; after the similarity alignment where the scale is not measured."""
    relative = rpe(
        estimate, reference, alignment="similarity" if truth.alignment == "similarity" else "rigid"
    )
    return {
        "rpe_translation_rmse_m": relative.translation_rmse,
        "rpe_rotation_rmse_deg": relative.rotation_rmse_deg,
        "scored_instants": len(reference),
    }


MERITS: tuple[Callable[[Trajectory, Trajectory, RunTruth], Mapping[str, float]], ...] = (
    absolute_errors,
    relative_errors,
)
"""Figures of merit of a path: the estimate and the truth at the same frames, and how they are brought together."""


def score_run(found: RunFolder) -> dict[str, Any]:
    """Entries of summary.json for the filter, the odometry alone and the batch optimum; none without ground truth.

    Those of the odometry begin with `odometry_` (in a stereo run with `vo_`), those of the optimum with `batch_`.
    """
    entries: dict[str, Any] = {}
    path = found.trajectory
    batch = read_tum(found.folder / BATCH) if (found.folder / BATCH).is_file() else None
    if (found.folder / TRUTH).is_file() and found.truth.rows.size >= LEAST:
        truth = found.truth
        entries |= score_estimate(found.estimate, truth, found.config.get("association") == "ml")
        reference = in_space(found.path.stamps_ns[truth.rows], truth.poses)
        for name, prefix in ((ODOMETRY, ODOMETRY_PREFIX.get(found.system, "odometry_")), (BATCH, "batch_")):
            if (found.folder / name).is_file():
                entries |= score_path(read_tum(found.folder / name), reference, truth, prefix)
    if batch is not None:
        ours, theirs = associate(path, batch, 0)
        floats = found.system == "mono" and found.summary.get("known_points") == 0
        apart = ate(ours, theirs, "similarity" if floats else "none")
        entries["filter_minus_batch_rmse_m"] = apart.rmse
    return entries


def score_estimate(estimate: PathAndMap, truth: RunTruth, anonymous: bool = False) -> dict[str, float]:
    """Errors of a path with a pose for every frame, and of its map; `anonymous` landmarks have no names."""
    reference = in_space(estimate.stamps_ns[truth.rows], truth.poses)
    ours = estimate.at(truth.rows).trajectory
    entries: dict[str, float] = {}
    for merit in MERITS:
        entries |= merit(ours, reference, truth)
    start = ate(ours, reference, "rigid").alignment if anonymous else None
    return entries | score_landmarks(estimate.landmarks, truth, start)


def score_path(
    path: Trajectory, reference: Trajectory, truth: RunTruth, prefix: str = ""
) -> dict[str, float]:
    """All figures of merit of a path whose frames are among those of a run; none where too few have a true pose."""
    try:
        estimate, reference = associate(path, reference, 0)
    except InputError:
        return {}
    entries: dict[str, float] = {}
    for merit in MERITS if len(estimate) >= LEAST else ():
        entries |= merit(estimate, reference, truth)
    return {prefix + name: value for name, value in entries.items()}


def score_landmarks(
    points: MapEstimate, truth: RunTruth, start: Similarity | None = None
) -> dict[str, float]:
    """Mean errors of landmarks whose true places are known, without and with an alignment of their own.

    Args:
        points: landmarks that are points.
        truth: with the true places by name.
        start: where the filter gave the landmarks no names, an alignment of the path: each landmark is then scored as
            the true one nearest to it, one to one.
    """
    if not truth.landmarks or not points.ids.size:
        return {}
    estimate = points.named() if start is None else match_points(points.mean, truth.landmarks, start)
    try:
        own, aligned = (
            landmark_errors(estimate, truth.landmarks),
            landmark_errors(estimate, truth.landmarks, "rigid"),
        )
    except InputError:  # no landmark is in both
        return {}
    return {"landmark_error_mean_m": own.mean, "landmark_error_aligned_mean_m": aligned.mean}
