"""Driver: a Gaussian unknown fitted to measurements of which some are wrong."""

import numpy as np
from numba import float64, int64, njit, void

from rbpf.kernels import dense
from rbpf.kernels.signature import CUBE, MATRIX, VECTOR


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
    # L⁻¹ν and L⁻¹H F of each measurement.
    for k in range(count):
        chol = cov[k].copy()
        dense.factor(chol)
        white_nu[k] = nu[k]
        dense.solve_lower(chol, white_nu[k])
        for r in range(rank):
            for a in range(p):
                total = 0.0
                for e in range(factor.shape[0]):
                    total += jac[k, a, e] * factor[e, r]
                white_jac[k, a, r] = total
            dense.solve_lower(chol, white_jac[k, :, r])
    for fitted in range(rounds + 1):
        for k in range(count):
            squared[k] = 0.0
            for a in range(p):
                left = white_nu[k, a]
                for r in range(rank):
                    left -= white_jac[k, a, r] * u[r]
                squared[k] += left * left
            weight[k] = 1.0 / (1.0 + squared[k] / (scale * scale))
        if fitted == rounds:
            break
        # The weighted estimate of an unknown that is N(0, I) before.
        info[:], u[:] = 0.0, 0.0
        for k in range(count):
            for a in range(p):
                row = white_jac[k, a]
                for r in range(rank):
                    scaled = weight[k] * row[r]
                    u[r] += scaled * white_nu[k, a]
                    for s in range(r + 1):
                        info[r, s] += scaled * row[s]
        for r in range(rank):
            info[r, r] += 1.0
        dense.factor(info)
        dense.solve(info, u)
