"""Numba only: linear algebra on blocks of particles, one observation at a time; no cameras, no files.

A block is `BLOCK` particles side by side, stored field by field (`(fields, BLOCK)`), so that every innermost loop
runs along particles and compiles to vector instructions. Lanes never mix: the result is the same bytes whatever
the number of threads. The docstrings of the drivers give the mathematics; `rbpf.core.linearisation` is their NumPy twin.
"""

from pathlib import Path

from rbpf.kernels.signature import discard_stale

discard_stale(Path(__file__).parent)
