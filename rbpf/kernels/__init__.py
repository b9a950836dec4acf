"""Numba only: linear algebra on blocks of particles, one observation at a time; no cameras, no files.

A block is `BLOCK` particles side by side, stored field by field (`(fields, BLOCK)`), so that every innermost loop
runs along particles and compiles to vector instructions. Lanes never mix: the result is the same bytes whatever
the number of threads. The docstrings of the drivers give the mathematics; `rbpf.reference` is their NumPy twin.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from rbpf.kernels.stale import discard_stale

_DRIVERS = (
    "refine",
    "update",
    "posterior",
    "forest",
    "rigid",
    "rigid_matrices",
    "gather",
    "project",
    "substate",
    "soundness",
    "robust_fit",
    "rigid_fit",
    "single",
)


def compile_once(announce: Callable[[], None]) -> None:
    """Loads the drivers; calls `announce` first where no compiled copy is cached beside them."""
    cache = Path(__file__).parent / "__pycache__"
    if not all(any(cache.glob(f"{name}.*.nbi")) for name in _DRIVERS):
        announce()
    for name in _DRIVERS:
        import_module(f"rbpf.kernels.{name}")


discard_stale(Path(__file__).parent)
