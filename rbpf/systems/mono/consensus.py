"""Which matches of a frame agree with one motion of the camera: a robust fit of the predicted pose.

A false match inside its search ellipse is not seen to be false before the pose is known, and then it is too late. The
increment ε ~ N(0, Q) of the heaviest particle's pose is fitted to all matches with a Cauchy loss on their Mahalanobis
distances (iteratively reweighted least squares); matches that stay far off take no part in the filter's step. The fit
also tells where what was not found should be seen: among things that look alike (the corners of a chessboard, a row of
windows) the right one is then nearest.
"""

from typing import NamedTuple

import numpy as np

from rbpf import gaussian

ROUNDS = 10
SCALE = 2.0
"""Of the loss: a match this many standard deviations off keeps half of its weight."""


class Fit(NamedTuple):
    """A motion that most of K matches agree on, ε = L u.

    Attributes:
        squared: (K,) squared Mahalanobis distance of each match from it.
        increment: (d,) ε.
        cov: (d, d) of ε.
    """

    squared: np.ndarray
    increment: np.ndarray
    cov: np.ndarray


def fit_motion(
    nu: np.ndarray, jac: np.ndarray, cov: np.ndarray, factor: np.ndarray, trusted: np.ndarray
) -> Fit:
    """The motion that the trusted ones of K matches agree on.

    Args:
        nu: (K, p) innovations at the predicted pose.
        jac: (K, p, d) by the pose, H.
        cov: (K, p, p) of the innovations given the pose, S = J P Jᵀ + R.
        factor: (d, r) of the prior's covariance, Q = L Lᵀ.
        trusted: (K,) which tell the motion; the others are only judged by it.
    """
    from rbpf.kernels.robust_fit import robust_fit

    rank = factor.shape[1]
    told, u, chol_info = np.empty(int(trusted.sum())), np.empty(rank), np.empty((rank, rank))
    rows = (np.ascontiguousarray(array[trusted], dtype=float) for array in (nu, jac, cov))
    robust_fit(*rows, np.ascontiguousarray(factor, dtype=float), ROUNDS, SCALE, told, u, chol_info)
    half = gaussian.solve_lower_matrix(chol_info, factor.T)
    increment, spread = factor @ u, half.T @ half
    squared = np.empty(nu.shape[0])
    squared[trusted] = told
    jac, cov, off = jac[~trusted], cov[~trusted], (nu - jac @ increment)[~trusted]
    given = cov + jac @ spread @ np.swapaxes(jac, -1, -2)
    squared[~trusted] = (off * np.linalg.solve(given, off[..., None])[..., 0]).sum(axis=-1)
    return Fit(squared, increment, spread)
