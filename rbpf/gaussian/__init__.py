"""Batched small Gaussians: factors, log-densities, sampling, conditioning, unscented transform.

Every function broadcasts over leading axes and is meant for n up to about twelve. Covariances are
full symmetric matrices (..., n, n); a chol_* is lower triangular, a factor L is any matrix with
L L^T = covariance. A result may lie in memory entry by entry, so that what is computed from it runs
along the batch: code that insists on C order takes its `numpy.ascontiguousarray`.
"""

from rbpf.gaussian.distributions import Gaussian, Transformed, condition, log_density, sample, unscented_transform
from rbpf.gaussian.matrices import (
    cholesky,
    inverse,
    log_det,
    pack,
    product,
    psd_factor,
    solve_lower,
    solve_lower_matrix,
    symmetrise,
    unpack,
)

__all__ = [
    "Gaussian",
    "Transformed",
    "cholesky",
    "condition",
    "inverse",
    "log_density",
    "log_det",
    "pack",
    "product",
    "psd_factor",
    "sample",
    "solve_lower",
    "solve_lower_matrix",
    "symmetrise",
    "unpack",
    "unscented_transform",
]
