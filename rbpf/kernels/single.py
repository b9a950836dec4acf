"""Driver: one call of a fused kernel, as the other drivers make it."""

from numba import int64, njit, void

from rbpf.kernels.signature import CUBE, KERNEL_TYPE, MATRIX, VECTOR


@njit(
    void(KERNEL_TYPE, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, int64, MATRIX, CUBE, CUBE),
    cache=True,
    error_model="numpy",
)
def call_kernel(kernel, state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    """Runs `kernel` on the lanes 0..n-1 of a block; arguments as in `rbpf.kernels.signature`."""
    kernel(state, mean, const, z, params, n, nu, jac_state, jac_landmark)
