"""Independent runs in parallel, one process each."""

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


def in_parallel(function: Callable[[Job], Result], jobs: Iterable[Job], workers: int) -> list[Result]:
    """Results of a module-level function, in the order of the jobs.

    Args:
        function: of one job; function, jobs and results must be picklable.
        jobs: any number.
        workers: number of processes; with 1 everything runs in this one.
    """
    if workers == 1:
        return [function(job) for job in jobs]
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_alone) as pool:
        return list(pool.map(function, jobs))


def _alone() -> None:
    """One thread per process: the processes already keep the machine busy."""
    import numba

    numba.set_num_threads(1)
