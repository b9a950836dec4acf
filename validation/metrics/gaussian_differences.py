"""Differences of two estimates' landmarks and poses, as Gaussians in one frame, chart and gauge.

The difference of the means is given in units of one's standard deviations; S. Kullback and R. Leibler (1951) compare the
whole densities, in natural units of information.
"""

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.plots import moved_map
from rbpf.runs.reading import PathAndMap
from rbpf.runs.trajectory import Similarity

#: Reported figures of each pair of Gaussians.
COLUMNS = ("distances_m", "sigmas", "kullback_leibler", "sigma_ratio")
#: Lengths below this fraction of the path's, and variances below this fraction of the largest, count as zero.
_TINY = 1e-9


def mahalanobis(delta: Array, cov: Array) -> Array:
    """sqrt(δᵀ P⁻¹ δ) of (…, n) and (…, n, n): (…)."""
    return np.sqrt(_square(delta, cov))


def kullback_leibler(delta: Array, cov_p: Array, cov_q: Array) -> Array:
    """KL(p ‖ q) of Gaussians whose means differ by δ (…, n), with covariances (…, n, n) [nats]: (…)."""
    trace = np.trace(np.linalg.solve(cov_q, cov_p), axis1=-2, axis2=-1)
    return np.asarray(0.5 * (trace + _square(delta, cov_q) - delta.shape[-1] + _log_det(cov_q) - _log_det(cov_p)))


def sigma_ratio(cov_p: Array, cov_q: Array) -> Array:
    """Mean standard deviation of p over that of q, (|P| / |Q|)^(1/2n): below 1 where p is the more certain: (…)."""
    return np.asarray(np.exp(0.5 * (_log_det(cov_p) - _log_det(cov_q)) / cov_p.shape[-1]), dtype=np.float64)


@final
@dataclass(frozen=True, eq=False)
class Differences:
    """K Gaussians of the filter, and those of the optimum."""

    keys: NDArray[np.int64]  #: (K,) names of landmarks, or steps of poses.
    distances_m: Array  #: (K,) between the means.
    sigmas: Array  #: (K,) between the means in the filter's standard deviations, √(δᵀ P_f⁻¹ δ).
    #: (K,) KL(optimum ‖ filter) [nats], the information loss of using the filter instead of the optimum.
    kullback_leibler: Array
    sigma_ratio: Array  #: (K,) the filter's mean standard deviation over the optimum's; below 1 is over-confident.
    delta: Array  #: (K, n) the filter's means less the optimum's, in the directions that are compared.
    cov: Array  #: (K, n, n) of the filter, there.
    cov_other: Array  #: (K, n, n) of the optimum, there.

    def __len__(self) -> int:
        return len(self.keys)

    def as_dict(self) -> dict[str, Any]:
        """Medians and 90 % quantiles for JSON, and every row."""
        figures: dict[str, Any] = {"count": len(self), "dims": self.delta.shape[-1]}
        for name in COLUMNS:
            values = getattr(self, name)
            if len(self):
                figures[f"{name}_median"] = float(np.median(values))
                figures[f"{name}_p90"] = float(np.quantile(values, 0.9))
        return figures | {"keys": self.keys.tolist()} | {name: getattr(self, name).tolist() for name in COLUMNS}


def compare_maps(ours: PathAndMap, other: PathAndMap, across: bool) -> Differences:
    """The landmarks common to two estimates of one world, without those that are exact in one of them.

    If the scale is not measured, they are compared only `across` the line from the first camera.
    """
    shared, rows, others = np.intersect1d(ours.landmarks.ids, other.landmarks.ids, return_indices=True)
    known = np.isfinite(other.landmarks.cov[others]).all(axis=(1, 2))
    shared, rows, others = shared[known], rows[known], others[known]
    delta = ours.landmarks.mean[rows] - other.landmarks.mean[others]
    covs = ours.landmarks.cov[rows], other.landmarks.cov[others]
    moved = other.landmarks.mean[others] - other.world_from_body[0, 4:] if across else None
    return _differences(shared, np.linalg.norm(delta, axis=1), delta, covs, moved)


def compare_last_pose(ours: PathAndMap, other: PathAndMap, step: int, across: bool) -> Differences:
    """The last poses of two estimates, in the chart at the other's, if both have covariances; see `compare_maps`."""
    if not (len(ours.cov_poses) and len(other.cov_poses)):
        none, no_cov = np.zeros((0, ours.space.dim)), np.zeros((0, ours.space.dim, ours.space.dim))
        return _differences(np.zeros(0, dtype=np.int64), none[:, 0], none, (no_cov, no_cov), None)
    space, mine, theirs = ours.space, ours.world_from_body[-1], other.world_from_body[-1]
    delta = space.local(theirs, mine)
    carry = space.right_jacobian_inverse(delta)
    covs = (carry @ ours.cov_poses[-1] @ carry.T)[None], other.cov_poses[-1][None]
    distances = np.linalg.norm(ours.trajectory.positions[-1:] - other.trajectory.positions[-1:], axis=1)
    moved = away_from_first(other.world_from_body)[-1:] if across else None
    return _differences(np.array([step]), distances, delta[None], covs, moved)


def away_from_first(poses: Array) -> Array:
    """Derivative (T, 6) of poses (T, 7) by the logarithm of a scale about the first one, in the chart at each."""
    along = SE3.rotation(poses).mT @ (poses[:, 4:] - poses[0, 4:])[..., None]
    return np.concatenate([np.zeros((len(poses), 3)), along[..., 0]], axis=1)


def scaled_onto(estimate: PathAndMap, rows: NDArray[np.intp], other: PathAndMap, name: str) -> tuple[PathAndMap, float]:
    """Scales a path and map of SE(3) about the first pose to fit another's positions best; also returns the factor.

    Raises InputError: the path does not move.
    """
    mine, theirs = (one.positions - one.positions[0] for one in (estimate.at(rows).trajectory, other.trajectory))
    square = float(np.square(mine).sum())
    if square <= _TINY**2:
        raise InputError(f"The gauge of {name} is not observable: the camera of the run stays where it began.")
    scale = float((mine * theirs).sum() / square)
    motion = Similarity(scale, np.eye(3), (1.0 - scale) * estimate.world_from_body[0, 4:])
    poses, points = motion.transform_poses(estimate.world_from_body), moved_map(estimate.landmarks, motion)
    by = np.repeat([1.0, scale], 3)
    return PathAndMap(estimate.stamps_ns, poses, estimate.cov_poses * np.outer(by, by), points), scale


def _differences(
    keys: NDArray[np.int64], distances: Array, delta: Array, covs: tuple[Array, Array], moved: Array | None
) -> Differences:
    if moved is not None:
        basis = across_of(moved)
        delta, covs = projected(basis, delta), (projected(basis, covs[0]), projected(basis, covs[1]))
    kept = _regular(covs[0]) & _regular(covs[1])
    delta, ours, theirs = delta[kept], covs[0][kept], covs[1][kept]
    return Differences(
        keys=keys[kept],
        distances_m=distances[kept],
        sigmas=mahalanobis(delta, ours),
        kullback_leibler=kullback_leibler(-delta, theirs, ours),
        sigma_ratio=sigma_ratio(ours, theirs),
        delta=delta,
        cov=ours,
        cov_other=theirs,
    )


def across_of(moved: Array) -> Array:
    """Orthonormal bases (K, n, n-1) of the complement of vectors (K, n)."""
    return np.linalg.svd(moved[:, None, :])[2][:, 1:].mT


def projected(basis: Array, values: Array) -> Array:
    """Vectors (K, n) or covariances (K, n, n) in bases (K, n, m)."""
    if values.ndim == 2:
        return np.einsum("kni,kn->ki", basis, values)
    return np.asarray(basis.mT @ values @ basis)


def _regular(cov: Array) -> NDArray[np.bool_]:
    values = np.linalg.eigvalsh(cov)
    return np.asarray(values[:, 0] > _TINY**2 * np.maximum(values[:, -1], np.finfo(float).tiny))


def _square(delta: Array, cov: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", delta, np.linalg.solve(cov, delta[..., None])[..., 0]))


def _log_det(cov: Array) -> Array:
    return np.asarray(np.linalg.slogdet(cov)[1], dtype=np.float64)
