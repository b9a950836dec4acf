"""Numba only: linear algebra on blocks of particles, one observation at a time; no cameras, no files.

A block is `BLOCK` particles in structure-of-arrays layout, `(fields, BLOCK)`, so that every innermost loop runs along
particles and compiles to vector instructions. Lanes never mix: the result is the same bytes on any number of threads.
The docstrings of the drivers give the mathematics; `rbpf.core.linearisation` is their NumPy twin.
"""

import atexit
import os
import shutil
import tempfile
import warnings
from pathlib import Path

import numba
from numba import njit

from rbpf.kernels.signature import discard_stale

discard_stale(Path(__file__).parent)


def _use_a_cache() -> None:
    """Uses a temporary folder of this process as Numba's cache if its usual one is not writable."""
    try:
        njit(cache=True)(_use_a_cache)
    except RuntimeError:
        folder = tempfile.mkdtemp(prefix="rbpf-kernels-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        # Also in the environment: Numba reads it again, and child processes use the same folder.
        os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = folder
        warnings.warn(
            "compiled kernels cannot be kept, since no folder for them can be written to: they are compiled anew in every "
            "run, which takes some minutes; set NUMBA_CACHE_DIR to a folder that can be written to",
            stacklevel=2,
        )


_use_a_cache()
