"""Observations linearised: Jacobians on the manifold, and the plain NumPy twins of the compiled drivers.

Shapes: N particles, K observations, p rows, d increment, D landmark. `mask` (N, K): who uses an observation; None is all.
"""

import numpy as np

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core.models import STEP, Jacobians, Likelihood, ObservationModel, Part
from rbpf.core.particles import Information, Prior
from rbpf.errors import InputError
from rbpf.lie import Array, LieGroup

EVERYTHING = frozenset({Part.STATE, Part.LANDMARK, Part.SUBSTATE})
#: Variance at which log|2πS| is zero: a row with it and zero residual and Jacobian has no effect.
_UNIT_NORMAL = 1.0 / (2.0 * np.pi)


def numeric_jacobians(
    model: ObservationModel,
    space: LieGroup,
    state: np.ndarray,
    landmark: np.ndarray | None = None,
    const: np.ndarray | None = None,
    substate: np.ndarray | None = None,
    by: frozenset[Part] = EVERYTHING,
) -> Jacobians:
    """Central differences of −ν at z = h, in the right chart at the state; `model.residual` wraps angles.

    Only by the parts in `by`: each coordinate costs two predictions.
    """
    steps = np.array([STEP, -STEP])
    constrains = type(model).innovation is not ObservationModel.innovation
    z = model.predict(state, landmark, const, substate) if constrains else None
    blocks: list[np.ndarray | None] = []
    for part, at in ((Part.STATE, state), (Part.LANDMARK, landmark), (Part.SUBSTATE, substate)):
        if at is None or part not in model.reads & by:
            blocks.append(None)
            continue
        dim = space.dim if part == Part.STATE else at.shape[-1]
        offsets = (steps[:, None, None] * np.eye(dim)).reshape(2, dim, *(1,) * (at.ndim - 1), dim)
        moved = space.retract(at, offsets) if part == Part.STATE else at + offsets
        moved_state = moved if part == Part.STATE else state
        moved_landmark = moved if part == Part.LANDMARK else landmark
        moved_substate = moved if part == Part.SUBSTATE else substate
        if z is not None:
            nu = model.innovation(z, moved_state, moved_landmark, const, moved_substate)
            difference = nu[1] - nu[0]
        else:  # saves half of the residuals
            difference = model.residual(*model.predict(moved_state, moved_landmark, const, moved_substate))
        blocks.append(np.moveaxis(difference, 0, -1) / (2 * STEP))
    return Jacobians(*blocks)


def linearise(
    model: ObservationModel,
    space: LieGroup,
    z: np.ndarray,
    state: np.ndarray,
    landmark: np.ndarray | None = None,
    const: np.ndarray | None = None,
    substate: np.ndarray | None = None,
    by: frozenset[Part] = EVERYTHING,
) -> tuple[np.ndarray, Jacobians]:
    """Innovation (N, K, p) and Jacobians at states (N, 1, E), landmarks (N, K, D), constants (N, K, A), substates (N, 1, m).

    Numeric Jacobians are computed only for the parts in `by`. Raises InputError: a result has the wrong shape.
    """
    nu = model.innovation(z, state, landmark, const, substate)
    name = type(model).__name__
    parts = (state, landmark, substate)
    if nu.dtype != np.float64:
        nu = numbers(nu, f"{name}.predict or its residual")
    expected = (*np.broadcast_shapes(*(part.shape[:-1] for part in parts if part is not None)), model.dim)
    if nu.shape != np.broadcast_shapes(expected, z.shape):
        raise InputError(f"{name}.predict returned shape {nu.shape}, expected {expected}")
    jacobians = model.jacobians(state, landmark, const, substate)
    if jacobians is None:
        jacobians = numeric_jacobians(model, space, state, landmark, const, substate, by)
    sizes = (space.dim, *(0 if part is None else part.shape[-1] for part in parts[1:]))
    blocks: list[np.ndarray | None] = []
    for block, size in zip(jacobians, sizes, strict=True):
        # A constant block may lack the leading axes.
        try:
            if block is not None and block.dtype != np.float64:
                block = numbers(block, f"{name}.jacobians")
            blocks.append(None if block is None else np.broadcast_to(block, (*expected, size)))
        except ValueError as error:
            shape = None if block is None else block.shape
            found = f"{name}.jacobians returned a block of shape {shape}"
            raise InputError(f"{found}, expected {(*expected, size)}") from error
    return nu, Jacobians(*blocks)


def innovation_covariance(jac: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """S = J P Jᵀ + R, (N, K, p, p): Mathematics (innovation-covariance)."""
    cross = gaussian.product(jac, cov)
    return gaussian.symmetrise(gaussian.product(cross, np.swapaxes(jac, -1, -2))) + noise


def information(
    nu: Array, jac_state: Array, cov: Array, likelihood: Likelihood, prior: Prior, mask: np.ndarray | None = None
) -> Information:
    """Information of independent observations with innovations ν (N, K, p), H (N, K, p, d), S (N, K, p, p).

    Observations that the likelihood classifies as outliers at the prediction, S + H Q Hᵀ, are not used in the refinement
    and contribute their outlier density.
    """
    n, k, p = nu.shape
    use, log_factor = mask, np.zeros(n)
    if likelihood.kernel_id != 0:
        use, log_factor = gated(nu, jac_state, cov, likelihood, prior, mask)
    if use is None:
        use = np.ones((n, k), dtype=bool)
    chol = gaussian.cholesky(cov)
    white_nu = gaussian.solve_lower(chol, nu) * use[..., None]
    white_jac = gaussian.solve_lower_matrix(chol, jac_state) * use[..., None, None]
    info = np.einsum("nkpa,nkpb->nab", white_jac, white_jac)
    vector = np.einsum("nkpa,nkp->na", white_jac, white_nu)
    log_det = np.zeros(n)
    if likelihood.normalised:
        log_det = ((gaussian.log_det(chol) + p * np.log(2.0 * np.pi)) * use).sum(axis=1)
    rows = p * use.sum(axis=1, dtype=float)
    return Information(info, vector, np.square(white_nu).sum(axis=(1, 2)), log_det, log_factor, rows)


def gated(
    nu: Array, jac_state: Array, cov: Array, likelihood: Likelihood, prior: Prior, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Mask (N, K) of observations used as inliers, and the log-density (N,) of this choice.

    The gate is at the prediction: its covariance is S + H Q Hᵀ.
    """
    spread = jac_state @ prior.factor[:, None]
    inlier = likelihood.predicted_inlier(nu, cov, cov + spread @ np.swapaxes(spread, -1, -2))
    seen = np.ones_like(inlier) if mask is None else mask.reshape(inlier.shape)
    used = seen & inlier
    return used, likelihood.log_inlier() * used.sum(axis=1) + likelihood.log_outlier() * (seen & ~inlier).sum(axis=1)


def updated(
    nu: Array, jac: Array, mean: Array, cov_map: Array, noise: Array, likelihood: Likelihood, mask: np.ndarray | None
) -> tuple[Array, Array, Array]:
    """Kalman updates of landmarks at sampled states, and each observation's log p(z | x).

    ν (N, K, p), J (N, K, p, D), means (N, K, D), covariances (N, K, D, D), R (K, p, p) → new means, covariances and
    log-densities (N, K).
    """
    cov = innovation_covariance(jac, cov_map, noise)
    use = likelihood.inlier(nu, cov)
    log_density = likelihood.log_density(nu, cov)
    if mask is not None:
        use = use & mask
        log_density = np.where(mask, log_density, 0.0)
    chol = gaussian.cholesky(cov)
    white = gaussian.solve_lower_matrix(chol, gaussian.product(jac, cov_map)) * use[..., None, None]
    new_mean = mean + np.einsum("nkpd,nkp->nkd", white, gaussian.solve_lower(chol, nu))
    new_cov = gaussian.symmetrise(cov_map - gaussian.product(np.swapaxes(white, -1, -2), white))
    return new_mean, new_cov, log_density


def stacked(
    nus: list[np.ndarray], jacs: list[np.ndarray], noises: list[np.ndarray], masks: list[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of several observations that share a landmark or a substate as one observation per particle.

    ν (N, p_j), J (N, p_j, c), R_j (p_j, p_j) → ν (N, Σp), J (N, Σp, c), R (N, Σp, Σp). A row that a particle does not use
    has no effect there.
    """
    n = nus[0].shape[0]
    sizes = [nu.shape[1] for nu in nus]
    ends = np.cumsum(sizes)
    nu, jac = np.concatenate(nus, axis=1), np.concatenate(jacs, axis=1)
    noise = np.zeros((n, ends[-1], ends[-1]))
    for end, size, part, mask in zip(ends, sizes, noises, masks, strict=True):
        rows = slice(end - size, end)
        noise[:, rows, rows] = part
        if mask is not None:
            seen = mask.reshape(n)
            nu[:, rows] *= seen[:, None]
            jac[:, rows] *= seen[:, None, None]
            noise[~seen, rows, rows] = _UNIT_NORMAL * np.eye(size)
    return nu, jac, noise
