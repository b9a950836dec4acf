"""Likelihoods and gating inside the kernels: the lanes in which an observation is an inlier, and its log-density.

Forms: 0 Gaussian, 1 truncated Mahalanobis (parameter 0: T_l, parameter 1: limit of updates), 2 Gaussian with outliers
(parameter 0: log(1−ε), parameter 1: log ε/V), 3 the truncated one for the look-ahead weight. `weight` is 1 for lanes that
use the observation and 0 for those that leave it out.
"""

import math

import numpy as np
from numba import njit

from rbpf.kernels.block import add_spread, whiten
from rbpf.kernels.signature import BLOCK


@njit(cache=True, error_model="numpy")
def accept_predicted(kernel_id, params, nu, jac_state, total, factor, start, count, weight, penalty):
    """Gates with the predictive covariance S + H Q Hᵀ; rejected lanes get the outlier density and weight 0.

    Log-density terms other than the Mahalanobis distance are added to `penalty`, times −2.
    """
    if kernel_id == 0:
        return
    p = nu.shape[0]
    spread = np.empty((p, p, BLOCK))
    white = np.empty((p, BLOCK))
    column = np.empty((p, BLOCK))
    squared = np.zeros(BLOCK)
    scale = np.ones(BLOCK)
    _copy_lower(total, count, spread)
    for a in range(p):
        for i in range(count):
            white[a, i] = nu[a, i]
    add_spread(jac_state, factor, start, count, column, spread)
    whiten(spread, count, white, scale, squared)
    if kernel_id == 3:
        # d² + log|S + H Q Hᵀ|/|S|, which makes it as probable as an outlier at the limit.
        for i in range(count):
            squared[i] -= 2.0 * math.log(scale[i])
            scale[i] = 1.0
        _copy_lower(total, count, spread)
        whiten(spread, count, white, scale, column[0])  # only for the pivots
        for i in range(count):
            squared[i] += 2.0 * math.log(scale[i])
    for i in range(count):
        if weight[i] == 0.0:
            continue
        if is_inlier(kernel_id, params, squared[i], scale[i], p):
            if kernel_id == 2:
                penalty[i] -= 2.0 * params[0]
        else:
            weight[i] = 0.0
            penalty[i] -= 2.0 * (params[1] if kernel_id == 2 else -0.5 * params[0])


@njit(cache=True, error_model="numpy")
def _copy_lower(total, count, out):
    for a in range(total.shape[0]):
        for b in range(a + 1):
            for i in range(count):
                out[a, b, i] = total[a, b, i]


@njit(cache=True, error_model="numpy")
def gaussian_log_density(squared, scale, p):
    """Log N from the squared Mahalanobis distance and the product of inverted Cholesky pivots."""
    return -0.5 * squared + math.log(scale) - 0.5 * p * math.log(2.0 * math.pi)


@njit(cache=True, error_model="numpy")
def is_inlier(kernel_id, params, squared, scale, p):
    """Whether the inlier term is at least the outlier term; for the truncated form, whether it is within the limit."""
    if kernel_id == 1 or kernel_id == 3:
        return squared <= params[1 if kernel_id == 1 else 0]
    return kernel_id == 0 or gaussian_log_density(squared, scale, p) + params[0] >= params[1]


@njit(cache=True, error_model="numpy")
def log_likelihood(kernel_id, params, squared, scale, p):
    """Log-density of an innovation under the likelihood `kernel_id`."""
    if kernel_id == 1:
        return -0.5 * min(squared, params[0])
    density = gaussian_log_density(squared, scale, p)
    if kernel_id == 0:
        return density
    high = max(density + params[0], params[1])
    return high + math.log1p(math.exp(min(density + params[0], params[1]) - high))


@njit(cache=True, error_model="numpy")
def leave_out(weight, count, nu, jac, total):
    """Lanes of weight 0 contribute nothing: ν = 0, J = 0, S = I."""
    p = nu.shape[0]
    for i in range(count):
        if weight[i] == 0.0:
            for a in range(p):
                nu[a, i] = 0.0
                for e in range(jac.shape[1]):
                    jac[a, e, i] = 0.0
                for b in range(a + 1):
                    total[a, b, i] = 1.0 if a == b else 0.0
