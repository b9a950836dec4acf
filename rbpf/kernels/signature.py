"""The type of a fused observation kernel, and the decorator that makes one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, final

from numba import cfunc, float64, int64, types, void
from numba.core import cgutils
from numba.extending import intrinsic

from rbpf.kernels.stale import discard_stale

BLOCK = 128
"""Particles per block: long enough that what a loop costs to start is small beside its work; in the L2 cache."""

FACTORS_PER_LOG = 18
"""Pivots multiplied before one logarithm is taken: 18 factors within 1e±16 stay inside the range of a double."""

VECTOR = types.Array(float64, 1, "C")
MATRIX = types.Array(float64, 2, "C")
CUBE = types.Array(float64, 3, "C")
READ_ONLY = types.Array(float64, 2, "C", readonly=True)
"""A matrix that is not written: the caller's may be locked."""
INDICES = types.Array(int64, 1, "C")
INDEX_MATRIX = types.Array(int64, 2, "C")
MASK = types.Array(types.boolean, 2, "C")

_SIGNATURE = void(MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, int64, MATRIX, CUBE, CUBE)
KERNEL_TYPE = types.FunctionType(_SIGNATURE)
"""First-class function type: the drivers call a kernel through a pointer, so they compile once for all models."""


@final
class ObservationKernel:
    """A compiled kernel; the drivers take its address, a plain number, which costs nothing to hand over."""

    def __init__(self, compiled: Any) -> None:
        self.compiled = compiled
        """Numba's object, which owns the machine code."""
        self.address = int(compiled.address)
        """Where the machine code starts."""


@intrinsic
def kernel_at(_typing: Any, address: Any) -> Any:
    """Inside a driver: the kernel that starts at an address (int64), as something to call."""

    def build(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        made = cgutils.create_struct_proxy(KERNEL_TYPE)(context, builder)
        made.c_addr = builder.inttoptr(arguments[0], cgutils.voidptr_t)
        made.py_addr = made.jit_addr = cgutils.get_null_value(cgutils.voidptr_t)
        return made._getvalue()

    return KERNEL_TYPE(address), build


def observation_kernel(function: Callable[..., None]) -> ObservationKernel:
    """Compiles `function(state, mean, const, z, params, n, nu, jac_state, jac_landmark)` into a fused kernel.

    Given one measurement `z` (p,) of one landmark, the kernel fills for the lanes 0..n-1
    the innovation `nu` (p, BLOCK) and the Jacobians `jac_state` (p, d, BLOCK), in the right chart at the state,
    and `jac_landmark` (p, D, BLOCK), from `state` (E, BLOCK), `mean` (D, BLOCK), `const` (A, BLOCK) and the
    model's `params` (P,). The last columns of `jac_state`, of a part of the state that is not read, may be left
    alone: they are zero. Write the body as a loop over lanes; it must not raise.
    """
    discard_stale(Path(function.__code__.co_filename).parent)
    return ObservationKernel(cfunc(_SIGNATURE, cache=True, error_model="numpy")(function))
