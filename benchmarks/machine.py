"""The machine on which the figures were measured."""

import os
import platform
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

_PACKAGES = ("numpy", "numba", "scipy", "particles", "stonesoup")
_COPIED_BYTES = 1 << 28


def cpu_name() -> str:
    """The processor's model name, if the system provides it."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def description() -> dict[str, Any]:
    """Processor, load and versions."""
    return {
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "load_at_start": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        **{package: _version(package) for package in _PACKAGES},
    }


def copy_bandwidth(threads: int = 2, repetitions: int = 5) -> float:
    """Bytes read plus bytes written per second by copying arrays far larger than the caches; the best of a few."""
    sources = [np.ones(_COPIED_BYTES // 8 // threads) for _ in range(threads)]
    targets = [np.zeros_like(source) for source in sources]
    best = np.inf
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(repetitions):
            start = time.perf_counter()
            list(pool.map(np.copyto, targets, sources))
            best = min(best, time.perf_counter() - start)
    return 2 * _COPIED_BYTES / best


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
