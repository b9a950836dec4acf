"""Time per step with maps of 100 to 100,000 landmarks; one landmark enters the view and one leaves in each step."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.rows import Row, Settings, Timing, interleaved
from benchmarks.worlds import Run, planar

N, K = 50, 30
SIZES = (100, 1_000, 10_000, 100_000)


class Stopwatch:
    """Collects the times of a function's calls."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call
        self.seconds: list[float] = []

    def __call__(self, *arguments: Any) -> Any:
        start = time.perf_counter()
        result = self.call(*arguments)
        self.seconds.append(time.perf_counter() - start)
        return result


class Sized:
    """A run on a map of m landmarks, with resampling timed separately."""

    def __init__(self, m: int, steps: int) -> None:
        self.run = Run(planar(K, m), N, steps)
        filter_ = self.run.filter
        self.advance = Stopwatch(filter_.lineage.advance)
        self.resample = Stopwatch(filter_.marginals.resample)
        setattr(filter_.lineage, "advance", self.advance)  # noqa: B010 - replaces a method
        setattr(filter_.marginals, "resample", self.resample)  # noqa: B010

    def resampling(self) -> Timing:
        """Advancing the lineage and compacting the map."""
        return Timing(np.array(self.advance.seconds) + np.array(self.resample.seconds))


def run(settings: Settings) -> list[Row]:
    """One row per size, against the smallest."""
    turns = settings.repetitions(600)
    warm_up = 150
    sized = {m: Sized(m, turns + warm_up) for m in SIZES}
    steps = interleaved({str(m): case.run.step for m, case in sized.items()}, turns, warm_up=warm_up)
    rows = []
    for m in SIZES[1:]:
        small, large = sized[SIZES[0]], sized[m]
        notes = large.run.diversity.text()
        rows.append(compare("update", m, steps[str(m)], steps[str(SIZES[0])], notes))
        part = large.resampling().seconds.sum() / (steps[str(m)].seconds.mean() * (turns + warm_up))
        fraction = f"{part:.1%} of the time of all steps; {notes}"
        rows.append(compare("resampling", m, large.resampling(), small.resampling(), fraction))
    return rows


def compare(what: str, m: int, large: Timing, small: Timing, notes: str) -> Row:
    ratio = large.median / small.median
    mean = f"mean {large.seconds.mean() * 1e3:.3g} against {small.seconds.mean() * 1e3:.3g} ms"
    return Row(
        f"{what}, {m} landmarks",
        large.median * 1e3,
        "ms",
        f"{SIZES[0]} landmarks",
        small.median * 1e3,
        ratio,
        higher=False,
        notes=f"{mean}; {large.spread}; {notes}",
        tolerance=0.15,
    )
