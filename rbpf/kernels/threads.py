"""How many threads a driver runs on: one for small work, so that a busy machine costs no wake-ups."""

from collections.abc import Iterator
from contextlib import contextmanager

import numba

PAIRS_PER_THREAD = 8192
"""Particle-observation pairs worth a thread: about half a millisecond of work, far above a wake-up."""


@contextmanager
def threads_for(pairs: int) -> Iterator[None]:
    """Limits the drivers called inside to as many threads as `pairs` of particle and observation keep busy."""
    allowed = numba.get_num_threads()
    numba.set_num_threads(max(1, min(allowed, pairs // PAIRS_PER_THREAD)))
    try:
        yield
    finally:
        numba.set_num_threads(allowed)
