"""Driver: a Gaussian unknown fitted to measurements of which some are wrong."""

import numpy as np
from numba import float64, int64, njit, void

from rbpf.kernels import dense
from rbpf.kernels.signature import CUBE, MATRIX, VECTOR


@njit(cache=True, error_model="numpy")
def _whiten(nu, jac, cov, factor, white_nu, white_jac):
    """L⁻¹ν and L⁻¹H F of one measurement."""
    chol = cov.copy()
    dense.factor(chol)
    white_nu[:] = nu
    dense.solve_lower(chol, white_nu)
    for r in range(factor.shape[1]):
        for a in range(nu.size):
            total = 0.0
            for e in range(factor.shape[0]):
                total += jac[a, e] * factor[e, r]
            white_jac[a, r] = total
        dense.solve_lower(chol, white_jac[:, r])


@njit(cache=True, error_model="numpy")
def _fit(white_nu, white_jac, weight, info, u):
    """The weighted estimate u of an unknown that is N(0, I) before."""
    info[:], u[:] = 0.0, 0.0
    for k in range(weight.size):
        for a in range(white_nu.shape[1]):
            row = white_jac[k, a]
            for r in range(u.size):
                scaled = weight[k] * row[r]
                u[r] += scaled * white_nu[k, a]
                for s in range(r + 1):
                    info[r, s] += scaled * row[s]
    for r in range(u.size):
        info[r, r] += 1.0
    dense.factor(info)
    dense.solve(info, u)


@njit(cache=True, error_model="numpy")
def _distances(white_nu, white_jac, u, squared):
    for k in range(squared.size):
        squared[k] = 0.0
        for a in range(white_nu.shape[1]):
            left = white_nu[k, a]
            for r in range(u.size):
                left -= white_jac[k, a, r] * u[r]
            squared[k] += left * left


@njit(void(MATRIX, CUBE, CUBE, MATRIX, int64, float64, VECTOR, VECTOR, MATRIX), cache=True, error_model="numpy")
def robust_fit(nu, jac, cov, factor, rounds, scale, squared, u, info):
    """Fills `squared` (K,) with the Mahalanobis distances that a robust fit leaves, `u` (r,) with the fit.

    Cauchy's loss by iteratively reweighted least squares, for innovations `nu` (K, p) = `jac` (K, p, d) `factor` (d, r)
    u + noise of covariance `cov` (K, p, p), with u ~ N(0, I). Measurements `scale` deviations off keep half a weight.
    The lower triangle of `info` (r, r) becomes the Cholesky factor of the last round's information.
    """
    count, p, rank = nu.shape[0], nu.shape[1], factor.shape[1]
    white_nu, white_jac = np.empty((count, p)), np.empty((count, p, rank))
    weight = np.empty(count)
    u[:] = 0.0
    for k in range(count):
        _whiten(nu[k], jac[k], cov[k], factor, white_nu[k], white_jac[k])
    _distances(white_nu, white_jac, u, squared)
    for _ in range(rounds):
        for k in range(count):
            weight[k] = 1.0 / (1.0 + squared[k] / (scale * scale))
        _fit(white_nu, white_jac, weight, info, u)
        _distances(white_nu, white_jac, u, squared)
