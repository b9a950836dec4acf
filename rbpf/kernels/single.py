"""Drivers: a fused kernel called as the other drivers do, and for one particle alone."""

import numpy as np
from numba import int64, njit, void

from rbpf.kernels.signature import BLOCK, CUBE, MATRIX, VECTOR, kernel_at


@njit(
    void(int64, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, int64, MATRIX, CUBE, CUBE),
    cache=True,
    error_model="numpy",
)
def call_kernel(address, state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Runs the kernel at `address` on the lanes 0..n-1 of a block; arguments as in `rbpf.kernels.signature`."""
    kernel = kernel_at(address)
    kernel(state, mean, const, z, params, n, nu, jac_state, jac_landmark)


@njit(
    void(int64, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, CUBE, CUBE),
    cache=True,
    error_model="numpy",
)
def linearise_one(address, params, state, mean, const, z, nu, jac_state, jac_landmark):
    """Fills `nu` (K, p), `jac_state` (K, p, d) and `jac_landmark` (K, p, D) of one particle's K landmarks.

    Its state is (E,), the landmarks are `mean` (K, D) and `const` (K, A), measured as `z` (K, p).
    """
    kernel = kernel_at(address)
    count, p = nu.shape
    x = np.empty((state.size, BLOCK))
    lane_mean, lane_const = np.empty((mean.shape[1], BLOCK)), np.empty((const.shape[1], BLOCK))
    lane_nu = np.empty((p, BLOCK))
    by_state = np.zeros((p, jac_state.shape[2], BLOCK))
    by_landmark = np.empty((p, jac_landmark.shape[2], BLOCK))
    x[:, 0] = state
    for k in range(count):
        lane_mean[:, 0], lane_const[:, 0] = mean[k], const[k]
        kernel(x, lane_mean, lane_const, z[k], params, 1, lane_nu, by_state, by_landmark)
        nu[k], jac_state[k], jac_landmark[k] = lane_nu[:, 0], by_state[:, :, 0], by_landmark[:, :, 0]
