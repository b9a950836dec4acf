"""Common to kernels: type and decorator of a fused observation kernel, threads, and stale copies in the cache."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from types import FunctionType
from typing import Any, final

import numba
from llvmlite import ir
from numba import cfunc, float64, int64, njit, prange, types, void
from numba.core import cgutils
from numba.extending import intrinsic

#: Particles per block: enough that a loop's overhead is small, and few enough that a block fits in the L2 cache.
BLOCK = 256
#: Pivots multiplied before a logarithm is taken: 18 factors within 1e±16 stay in the range of a double.
FACTORS_PER_LOG = 18
#: Particle-observation pairs per thread: a quarter of a millisecond of work, far above a thread's wake-up time.
PAIRS_PER_THREAD = 8192

VECTOR = types.Array(float64, 1, "C")
MATRIX = types.Array(float64, 2, "C")
CUBE = types.Array(float64, 3, "C")
HYPERCUBE = types.Array(float64, 4, "C")
READ_ONLY = types.Array(float64, 2, "C", readonly=True)  #: A read-only matrix: the caller's array may be locked.
INDICES = types.Array(int64, 1, "C")
INDEX_MATRIX = types.Array(int64, 2, "C")
MASK = types.Array(types.boolean, 2, "C")

_SIGNATURE = void(MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, int64, MATRIX, CUBE, CUBE)


@final
class ObservationKernel:
    """A compiled kernel; the drivers take its address, a plain number, which costs nothing to pass."""

    def __init__(self, compiled: Any) -> None:
        self.compiled = compiled  #: Numba's object that owns the machine code.
        self.address = int(compiled.address)  #: Address of the machine code.

    def __deepcopy__(self, memo: object) -> "ObservationKernel":
        return self  # machine code


def _function_at(signature: Any, *given: Any) -> Any:
    """Implements an intrinsic that returns the function at an address (int64), its first argument."""
    kind = types.FunctionType(signature)

    def build(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        made = cgutils.create_struct_proxy(kind)(context, builder)
        made.c_addr = builder.inttoptr(arguments[0], cgutils.voidptr_t)
        made.py_addr = made.jit_addr = cgutils.get_null_value(cgutils.voidptr_t)
        return made._getvalue()

    return kind(*given), build


@intrinsic
def kernel_at(_typing: Any, address: Any) -> Any:
    """The kernel at an address, by which the drivers are compiled once for all models."""
    return _function_at(_SIGNATURE, address)


@intrinsic
def _part_at(_typing: Any, address: Any, arguments: Any) -> Any:
    return _function_at(void(int64, arguments), address, arguments)


@intrinsic
def prefetch(_typing: Any, address: Any) -> Any:
    """Prefetches the cache line at an address (int64), without waiting for it."""

    def build(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        read, nearest, data = (ir.Constant(number, value) for value in (0, 3, 1))
        builder.call(ask, [builder.inttoptr(arguments[0], byte), read, nearest, data])

    return types.void(types.int64), build


def _on_threads(address, parts, arguments):
    for part in prange(parts):
        _part_at(address, arguments)(int64(part), arguments)


def _in_turn(address, parts, arguments):
    for part in range(parts):
        _part_at(address, arguments)(part, arguments)


@final
class Driver:
    """A loop over parts, each processed by `function(part, arguments)`, on threads or `alone`.

    A parallel loop that calls a function by its address compiles in a tenth of the time of one with the body in place, which
    Numba compiles four times. Starting the threads costs a twentieth of a small update.
    """

    def __init__(self, function: Callable[..., None], arguments: Any) -> None:
        self._part = cfunc(void(int64, arguments), cache=True, error_model="numpy")(function)
        self._address = int(self._part.address)
        signature, options = void(int64, int64, arguments), {"cache": True, "error_model": "numpy"}
        self._on_threads = njit(signature, parallel=True, **options)(_of_its_own(_on_threads, function))
        self._in_turn = njit(signature, **options)(_of_its_own(_in_turn, function))

    def __call__(self, parts: int, *arguments: Any) -> None:
        self._on_threads(self._address, parts, arguments)

    def alone(self, parts: int, *arguments: Any) -> None:
        """Runs the loop on this thread."""
        self._in_turn(self._address, parts, arguments)


def _of_its_own(loop: Any, function: Any) -> Any:
    """A loop under a unique name: processes that compile several at a time must not write to the same cache file."""
    own = FunctionType(loop.__code__, loop.__globals__)
    own.__qualname__ = f"{function.__module__}.{function.__name__}.{loop.__name__}"
    return own


def in_parts(*arguments: Any) -> Callable[[Callable[..., None]], Driver]:
    """Compiles a function of a part and arguments of these types, none of which is itself a tuple, into a `Driver`."""
    return partial(Driver, arguments=types.Tuple(arguments))


def observation_kernel(function: Callable[..., None]) -> ObservationKernel:
    """Compiles `function(state, mean, const, z, params, n, nu, jac_state, jac_landmark)` into a fused kernel.

    Given one measurement `z` (p,) of one landmark, the kernel fills, for lanes 0..n-1, the innovation `nu` (p, BLOCK)
    and the Jacobians `jac_state` (p, d, BLOCK), in the right chart at the state, and `jac_landmark` (p, D, BLOCK), from
    `state` (E, BLOCK), `mean` (D, BLOCK), `const` (A, BLOCK) and the model's `params` (P,). Trailing columns of
    `jac_state`, for parts of the state that are not observed, are zero and may be left as they are. Write the body as a
    loop over lanes; it must not raise.
    """
    discard_stale(Path(function.__code__.co_filename).parent)
    return ObservationKernel(cfunc(_SIGNATURE, cache=True, error_model="numpy")(function))


def run_driver(driver: Driver, pairs: int, parts: int, *arguments: Any) -> None:
    """Calls a driver on as many threads as the number of particle-observation `pairs` keeps busy."""
    if pairs < 2 * PAIRS_PER_THREAD:
        driver.alone(parts, *arguments)
        return
    allowed = numba.get_num_threads()
    wanted = min(allowed, pairs // PAIRS_PER_THREAD)
    if wanted == allowed:
        driver(parts, *arguments)
        return
    numba.set_num_threads(wanted)
    try:
        driver(parts, *arguments)
    finally:
        numba.set_num_threads(allowed)


_PACKAGE = Path(__file__).resolve().parents[1]


def discard_stale(folder: Path) -> None:
    """Deletes compiled copies of the modules in a folder that are older than any kernel source of this package.

    Numba's cache detects changes in a function's own file, but not in the functions and constants that it uses: a stale
    copy could run with another block size and write outside its arrays.
    """
    places = [folder / "__pycache__"]
    if numba.config.CACHE_DIR:
        places = [place for place in Path(numba.config.CACHE_DIR).glob("*") if place.is_dir()]
    for place in places:
        for index in place.glob("*.nbi"):
            with suppress(FileNotFoundError):  # another process may delete it at the same time
                if index.stat().st_mtime < _newest_source():
                    index.unlink()


@cache
def _newest_source() -> float:
    patterns = "kernels/*.py", "*/*kernel*.py", "*/*/*kernel*.py"
    sources = [source for pattern in patterns for source in _PACKAGE.glob(pattern)]
    return max(source.stat().st_mtime for source in sources)
