"""How many threads a driver runs on: one for small work, so that a busy machine costs no wake-ups."""

from collections.abc import Callable
from typing import Any

import numba

PAIRS_PER_THREAD = 8192
"""Particle-observation pairs worth a thread: a quarter of a millisecond of work, far above a wake-up."""


def run_driver(driver: Callable[..., None], pairs: int, *arguments: Any) -> None:
    """Calls a driver on as many threads as `pairs` of particle and observation keep busy."""
    allowed = numba.get_num_threads()
    wanted = max(1, min(allowed, pairs // PAIRS_PER_THREAD))
    if wanted == allowed:
        driver(*arguments)
        return
    numba.set_num_threads(wanted)
    try:
        driver(*arguments)
    finally:
        numba.set_num_threads(allowed)
