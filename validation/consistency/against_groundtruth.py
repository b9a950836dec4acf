"""A run against the ground truth of its recording: errors, and their consistency with the filter's covariances.

Gauge. A run in the truth's world is compared without alignment. Otherwise the truth is transformed to the run's world, in
which the filter's covariances are given: by the rigid motion (after the scale that fits the positions, if the recording's is
arbitrary) of maximum likelihood under these covariances. The remaining error can contradict the filter, and supports it only
if it would also do so without the fitted degrees of freedom. If the scale is arbitrary, errors are measured perpendicular to
the line from the first pose, which are invariant to scale.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.runs.files import BATCH
from rbpf.runs.plots import moved_map
from rbpf.runs.reading import RunFolder
from rbpf.runs.trajectory import Similarity, align, associate, in_space, read_tum
from rbpf.runs.truth import EXACT, LEAST, Precision, RunTruth
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.consistency import statistic
from rbpf.validation.consistency.comparison import Comparison
from rbpf.validation.metrics.accuracy import AbsoluteError, ate, rpe
from rbpf.validation.metrics.gaussian_differences import across_of, away_from_first, projected
from rbpf.validation.metrics.scores import is_anonymous

NEES, LANDMARKS = "poses against the truth", "landmarks against the truth"

_HOW = {
    "none": "without any alignment",
    "rigid": "after a rigid alignment",
    "similarity": "after an alignment with scale (the recording's own scale is arbitrary)",
}


@dataclass(frozen=True)
class TruthErrors:
    """Errors of a run relative to the truth."""

    positions: AbsoluteError  #: errors of the aligned positions.
    whitened: statistic.WhitenedErrors  #: errors of the poses, whitened by the filter's covariances.
    fitted: int  #: parameters of the alignment of the truth to the run's world; 0 without one.
    landmarks: "LandmarkErrors | None"  #: the map's points with known true positions; or None.
    stated: Precision  #: precision of the truth itself.
    claimed: float  #: fraction of the expected squared errors of the poses that is due to the filter, not the truth.


@dataclass(frozen=True)
class LandmarkErrors:
    """M landmarks and their true positions."""

    map: MapEstimate  #: the run's, aligned to the truth's world as the path.
    truth: np.ndarray  #: (M, D) true places.
    white: np.ndarray  #: (M, d) whitened errors; d is D, or D − 1 if the scale is arbitrary.

    @property
    def squares(self) -> np.ndarray:
        """(M,) normalised squared errors; a consistent filter's are χ² of d."""
        return np.square(self.white).sum(axis=1)


def truth_errors(record: RunFolder, stated: Precision = EXACT) -> TruthErrors:
    """Errors of a run relative to a truth with poses of the stated precision and exact landmarks.

    Raises InputError: the run has no truth, or too little.
    """
    path, truth = record.path, record.truth
    if truth.rows.size < LEAST:
        raise InputError(f"{record.folder}: {truth.rows.size} steps have a true pose, a comparison needs {LEAST}")
    reference = in_space(path.stamps_ns[truth.rows], truth.poses)
    positions = ate(path.at(truth.rows).trajectory, reference, truth.alignment)
    mean, cov = path.world_from_body[truth.rows], path.cov_poses[truth.rows]
    anonymous, space, across = is_anonymous(record), path.space, truth.alignment == "similarity"
    turns = 1 if space.dim == SE2.dim else 3
    own = np.repeat([stated.std_rad**2, stated.std_m**2], [turns, space.dim - turns])
    # Aligning the truth to the same first pose spreads that pose's error over the whole path.
    moved_by_first = any(stated) and np.array_equal(truth.poses[0], space.identity())
    if truth.alignment == "none" and not moved_by_first:
        both = cov + np.diag(own)
        whitened = statistic.whitened_errors(space, mean, both, truth.poses)
        landmarks = None if anonymous else _landmark_errors(record, truth, positions.alignment)
        return TruthErrors(positions, whitened, 0, landmarks, stated, _claimed(cov, both))
    # The truth, transformed to the run's world.
    true, ours = (in_space(path.stamps_ns[truth.rows], poses) for poses in (truth.poses, mean))
    start = align(true.positions, ours.positions, with_scale=across)
    own[turns:] *= start.scale**2
    if space.dim == SE2.dim:
        plane = start.in_dimension(2)
        turned = np.array([np.arctan2(plane.rotation[1, 0], plane.rotation[0, 0]), *plane.translation])
        moved = space.compose(turned, truth.poses)
    else:
        plane, moved = start, start.transform_poses(truth.poses)
    basis = np.broadcast_to(np.eye(space.dim), cov.shape)
    if across:
        basis = across_of(away_from_first(path.world_from_body)[truth.rows])
    both = projected(basis, cov + np.diag(own))
    roots, ranks = statistic.inverse_roots(both)

    def errors(motion: np.ndarray) -> np.ndarray:
        there = space.local(mean, space.compose(space.exp(motion), moved))
        return np.einsum("tab,tb->ta", roots, projected(basis, there))

    motion = least_squares(lambda x: errors(x).ravel(), np.zeros(space.dim), method="lm").x
    turn = space.exp(motion)
    points = {name: space.transform(turn, plane.transform(point)) for name, point in truth.landmarks.items()}
    there = RunTruth(truth.rows, space.compose(turn, moved), points, truth.alignment)
    landmarks = None if anonymous else _landmark_errors(record, there, positions.alignment)
    whitened = statistic.WhitenedErrors(errors(motion), ranks)
    return TruthErrors(positions, whitened, space.dim, landmarks, stated, _claimed(projected(basis, cov), both))


def pose_statistics(errors: statistic.WhitenedErrors, fitted: int = 0) -> list[statistic.Statistic]:
    """NEES of the poses and coverage of their credible regions; none if all poses are exact.

    `fitted` parameters were chosen to minimise the errors: the upper end of the interval is raised by their effect on errors
    with so few degrees of freedom.
    """
    known = errors.ranks > 0
    if not known.any():
        return []
    dim = errors.errors.shape[1]
    dof, nees = statistic.degrees_of_freedom(errors.errors[known]), errors.nees[known]
    ratio = statistic.variance_ratio(NEES, float(nees.sum() / errors.ranks[known].sum()), dof, statistic.STATE_FACTOR)
    ratio = replace(ratio, high=ratio.high * (1.0 + fitted / dof))
    full = errors.ranks[known] == dim
    samples = max(dof**2 / (dof + fitted) / dim, 1.0)
    return [ratio, *(statistic.coverage(nees[full], dim, samples) if full.any() else [])]


def compare_with_truth(record: RunFolder, errors: TruthErrors) -> Comparison:
    """The comparison of a run with the truth, from its `truth_errors`."""
    path, truth, at = record.path, record.truth, errors.positions
    reference = in_space(path.stamps_ns[truth.rows], truth.poses)
    accuracy = (
        f"The path is {_metres(at.rmse)} (rms) from the truth, {_metres(at.max)} at worst, over {at.keys.size} of "
        f"{len(path.world_from_body)} steps {_HOW[truth.alignment]}"
    )
    relative = rpe(path.at(truth.rows).trajectory, reference, alignment=at.alignment)
    figures: dict[str, Any] = {
        "alignment": truth.alignment,
        "steps_compared": int(truth.rows.size),
        "position_rmse_m": at.rmse,
        "position_max_m": at.max,
        "path_spread_m": reference.spread,
        "motion_translation_rmse_m": relative.translation_rmse,
        "motion_rotation_rmse_deg": relative.rotation_rmse_deg,
    }
    if any(errors.stated):
        std_m, std_deg = errors.stated.std_m, float(np.degrees(errors.stated.std_rad))
        accuracy += f"; the truth itself is taken to be good to {_metres(std_m)} and {std_deg:.2g}°"
        figures |= {"truth_std_m": std_m, "truth_std_deg": std_deg}
    known, white = errors.whitened.ranks > 0, errors.whitened
    nees, ranks = (values[known] if known.any() else np.zeros(1) for values in (white.nees, white.ranks))
    statistics = pose_statistics(white, errors.fitted)
    if any(errors.stated):  # regions are of both
        statistics = [_of_filter(ratio, errors.claimed) for ratio in statistics[:1]] if errors.claimed else []
    figures |= {"pose_nees_mean": float(nees.mean()), "pose_nees_median": float(np.median(nees))}
    figures["pose_nees_right"] = float(ranks.mean())
    if errors.landmarks is not None:
        found = errors.landmarks
        figures |= {
            "landmarks_compared": len(found.truth),
            "landmark_rmse_m": float(np.sqrt(np.square(found.map.mean - found.truth).sum(axis=1).mean())),
            "landmark_nees_mean": float(found.squares.mean()),
            "landmark_nees_right": float(found.white.shape[1]),
        }
        statistics.append(statistic.map_ratio(LANDMARKS, found.truth, found.white))
    # The batch optimum's positions at the same steps, aligned in the same way, where the run has one.
    if (record.folder / BATCH).is_file():
        batch, beside = associate(read_tum(record.folder / BATCH), reference, 0)
        if 2 * batch.stamps_ns.size >= truth.rows.size:  # an alignment fits a few poses anywhere
            rmse = ate(batch, beside, truth.alignment).rmse
            figures["batch_position_rmse_m"] = rmse
            accuracy += f"; the batch optimum of the same measurements is {_metres(rmse)} from it"
    return Comparison("groundtruth", f"{accuracy}.", figures, statistics)


def _claimed(cov: np.ndarray, both: np.ndarray) -> float:
    """Mean of tr S⁻¹ P per degree of freedom, of covariances P of S (T, d, d)."""
    roots, ranks = statistic.inverse_roots(both)
    return float(np.einsum("tab,tbc,tca->", roots, cov, roots) / max(ranks.sum(), 1))


def _of_filter(ratio: statistic.Statistic, claimed: float) -> statistic.Statistic:
    """The ratio of errors to their expectation by filter and truth together, corrected for the truth's errors.

    The interval allows for a truth whose standard deviations are wrong by `STATE_FACTOR`: one that is coarser than the
    filter's covariances neither supports nor contradicts it. One with errors below half of the stated ones may be exact.
    """
    rest, most = 1.0 - claimed, statistic.STATE_FACTOR**2
    offs = {"value": rest, "low": most * rest, "high": rest / most if ratio.high > rest / most else 0.0}
    found = {name: max(getattr(ratio, name) - off, 0.0) / claimed for name, off in offs.items()}
    return replace(ratio, samples=claimed**2 * ratio.samples, **found)


def _landmark_errors(record: RunFolder, truth: RunTruth, world: Similarity) -> LandmarkErrors | None:
    """Landmark errors relative to a truth in the run's world, without landmarks that are exact for the filter."""
    found = record.map.points()
    regular = np.linalg.eigvalsh(found.cov)[:, 0] > 0.0
    kept = np.array([name in truth.landmarks for name in found.ids.tolist()], dtype=bool) & regular
    if not kept.any():
        return None
    found = MapEstimate(found.ids[kept], found.mean[kept], found.cov[kept])
    delta, cov = np.array([truth.landmarks[name] for name in found.ids.tolist()]) - found.mean, found.cov
    if truth.alignment == "similarity":
        basis = across_of(found.mean - record.path.world_from_body[0, 4:])
        delta, cov = projected(basis, delta), projected(basis, cov)
    moved = moved_map(found, world)
    true = np.array([record.truth.landmarks[name] for name in found.ids.tolist()])
    return LandmarkErrors(moved, true, np.einsum("mab,mb->ma", statistic.inverse_roots(cov)[0], delta))


def _metres(value: float) -> str:
    return f"{1e3 * value:.2g} mm" if value < 0.0995 else f"{value:.2f} m"
