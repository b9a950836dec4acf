"""Driver: whether measurements and their covariances are what they should be."""

import math

import numpy as np
from numba import boolean, njit, types

from rbpf.kernels.signature import READ_ONLY

_READ_CUBE = types.Array(types.float64, 3, "C", readonly=True)


@njit(cache=True, error_model="numpy")
def _is_definite(cov, factor):
    """Whether a matrix is finite, symmetric to the bit and positive definite."""
    for a in range(cov.shape[0]):
        for b in range(a + 1):
            if cov[a, b] != cov[b, a] or not math.isfinite(cov[a, b]):
                return False
            rest = cov[a, b]
            for c in range(b):
                rest -= factor[a, c] * factor[b, c]
            if b < a:
                factor[a, b] = rest / factor[b, b]
            elif rest > 0.0:
                factor[a, a] = math.sqrt(rest)
            else:
                return False
    return True


@njit(boolean(READ_ONLY, _READ_CUBE), cache=True, error_model="numpy")
def are_sound(z, cov):
    """Whether z (K, p) is finite and every cov (K, p, p) finite, symmetric to the bit and positive definite."""
    factor = np.empty(cov.shape[1:])
    for k in range(z.shape[0]):
        for a in range(z.shape[1]):
            if not math.isfinite(z[k, a]):
                return False
        if not _is_definite(cov[k], factor):
            return False
    return True
