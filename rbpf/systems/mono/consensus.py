"""Which matches of a frame agree with one motion of the camera: a robust fit of the predicted pose.

A false match inside its search ellipse is not seen to be false before the pose is known, and then it is too late. The
increment ε ~ N(0, Q) of the heaviest particle's pose is fitted to all matches with a Cauchy loss on their Mahalanobis
distances (iteratively reweighted least squares); matches that stay far off take no part in the filter's step.
"""

import numpy as np

ROUNDS = 10
SCALE = 2.0
"""Of the loss: a match this many standard deviations off keeps half of its weight."""


def agreeing(nu: np.ndarray, jac: np.ndarray, cov: np.ndarray, factor: np.ndarray, gate: float) -> np.ndarray:
    """Which of K matches agree, (K,) bool.

    Args:
        nu: (K, p) innovations at the predicted pose.
        jac: (K, p, d) by the pose, H.
        cov: (K, p, p) of the innovations given the pose, S = J P Jᵀ + R.
        factor: (d, r) of the prior's covariance, Q = L Lᵀ.
        gate: on the squared Mahalanobis distance that is left, χ² with p degrees of freedom.
    """
    from rbpf.kernels.robust_fit import robust_fit

    squared = np.empty(nu.shape[0])
    arrays = (np.ascontiguousarray(array, dtype=float) for array in (nu, jac, cov, factor))
    robust_fit(*arrays, ROUNDS, SCALE, squared)
    return np.asarray(squared <= gate)
