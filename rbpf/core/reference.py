"""Plain NumPy twins of the compiled drivers; they also serve models without a kernel and rows that are stacked.

Shapes: N particles, K observations, p rows, d increment, D landmark. `mask` (N, K) says which particles saw an
observation; None is all.
"""

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Likelihood
from rbpf.core.proposals import Prior, Proposed, Terms

_UNIT_NORMAL = 1.0 / (2.0 * np.pi)
"""Variance at which log|2πS| is zero: a row of it, with zero residual and Jacobian, says nothing."""


def innovation_covariance(jac: np.ndarray, cov: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """S = J P Jᵀ + R, (N, K, p, p): Mathematics (innovation-covariance)."""
    cross = gaussian.product(jac, cov)
    return gaussian.symmetrise(gaussian.product(cross, np.swapaxes(jac, -1, -2))) + noise


def information(
    nu: np.ndarray,
    jac_state: np.ndarray,
    cov: np.ndarray,
    likelihood: Likelihood,
    prior: Prior,
    mask: np.ndarray | None = None,
) -> Terms:
    """Terms of independent observations with innovations ν (N, K, p), H (N, K, p, d), S (N, K, p, p).

    An observation that the likelihood calls an outlier at the prediction, S + H Q Hᵀ, takes no part in the
    refinement and enters by its outlier density.
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
    return Terms(info, vector, np.square(white_nu).sum(axis=(1, 2)), log_det, log_factor, k * p)


def log_normaliser(cov: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """½ log|2πS| of some of the stacked rows, (N, p, p) and (p,) bool → (N,)."""
    chol = gaussian.cholesky(2.0 * np.pi * cov[:, rows][:, :, rows])
    return 0.5 * gaussian.log_det(chol)


def gated(
    nu: np.ndarray,
    jac_state: np.ndarray,
    cov: np.ndarray,
    likelihood: Likelihood,
    prior: Prior,
    mask: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Which particles take an observation as an inlier (N, K), and the log-density (N,) that this adds.

    The gate is at the prediction: its covariance is S + H Q Hᵀ.
    """
    spread = jac_state @ prior.factor[:, None]
    cov = cov + spread @ np.swapaxes(spread, -1, -2)
    inlier = likelihood.inlier(nu, cov)
    seen = np.ones_like(inlier) if mask is None else mask.reshape(inlier.shape)
    used = seen & inlier
    return used, likelihood.log_inlier() * used.sum(axis=1) + likelihood.log_outlier() * (seen & ~inlier).sum(
        axis=1
    )


def updated(
    nu: np.ndarray,
    jac: np.ndarray,
    mean: np.ndarray,
    cov_map: np.ndarray,
    noise: np.ndarray,
    likelihood: Likelihood,
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kalman updates of landmarks at sampled states, and each observation's log p(z | x).

    Given ν (N, K, p), J (N, K, p, D), means (N, K, D), covariances (N, K, D, D) and R (K, p, p), returns the new
    means and covariances and log-densities (N, K).
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

    Given ν (N, p_j), J (N, p_j, c) and R_j (p_j, p_j), returns ν (N, Σp), J (N, Σp, c) and R (N, Σp, Σp). A row that
    a particle did not see says nothing there.
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


def refined(prior: Prior, terms: Terms) -> Proposed:
    """NumPy twin of `rbpf.core.proposals.refined`."""
    rank = prior.factor.shape[2]
    matrix = np.eye(rank) + np.einsum("nar,nab,nbs->nrs", prior.factor, terms.info, prior.factor)
    linear = np.einsum("nar,na->nr", prior.factor, terms.vector)
    chol = np.linalg.cholesky(gaussian.symmetrise(matrix))
    root = np.swapaxes(np.linalg.inv(chol), -1, -2)
    white = np.einsum("nba,nb->na", root, linear)
    nis = terms.quad - np.square(white).sum(axis=1)
    log_w1 = -0.5 * (nis + terms.log_det + gaussian.log_det(chol)) + terms.log_factor
    return Proposed(np.einsum("nab,nb->na", root, white), root, log_w1, nis, terms.rows)
