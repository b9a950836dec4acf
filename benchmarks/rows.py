"""Result rows of benchmarks, and interleaved timing of contestants."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rbpf.core.filter import Filter
from rbpf.maps.landmark_map import LandmarkMap

GENERATIONS_BACK = 20


class SkippedError(Exception):
    """A benchmark cannot run here; the message gives the reason."""


@dataclass(frozen=True)
class Settings:
    """Extent of a run; `quick` reduces repetitions, never sizes."""

    quick: bool = False

    def repetitions(self, full: int) -> int:
        """The repetitions; a third of them, at least 3, in a quick run."""
        return max(3, full // 3) if self.quick else full


@dataclass(frozen=True)
class Row:
    """One figure with the baseline measured in the same run.

    Attributes:
        name: unique, the key in the committed baseline.
        figure: the measured value, in `unit`.
        baseline: description of the peer or floor that it is compared with;  baseline_figure: its value, in the same unit.
        ratio: the value checked by the gate, which does not depend on the machine's speed.
        higher: whether a higher ratio is better.
        tolerance: relative change of the ratio that the gate accepts.
        optional: whether the row may be missing on a machine without the peer.
    """

    name: str
    figure: float
    unit: str
    baseline: str
    baseline_figure: float
    ratio: float
    higher: bool = True
    notes: str = ""
    tolerance: float = 0.35
    optional: bool = False

    def plain(self) -> dict[str, Any]:
        """For a JSON file."""
        return {key: value.item() if isinstance(value, np.generic) else value for key, value in asdict(self).items()}


@dataclass(frozen=True)
class Timing:
    """Seconds of each call."""

    seconds: np.ndarray

    @property
    def median(self) -> float:
        return float(np.median(self.seconds))

    @property
    def spread(self) -> str:
        """Quartiles and the worst call, in milliseconds."""
        low, high = np.percentile(self.seconds, (25, 75)) * 1e3
        return f"quartiles {low:.3g}-{high:.3g} ms, worst {self.seconds.max() * 1e3:.3g} ms"


def interleaved(
    contestants: dict[str, Callable[[], Any]], repetitions: int, calls: dict[str, int] | None = None, warm_up: int = 2
) -> dict[str, Timing]:
    """Times the contestants in turn, so that changes of the machine's load affect all of them alike.

    Args:
        contestants: functions by name.
        repetitions: number of turns.
        calls: number of calls per contestant and turn, timed individually; by default 1.
        warm_up: number of turns that are not timed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for repetition in range(-warm_up, repetitions):
        for name, run in contestants.items():
            for _ in range((calls or {}).get(name, 1)):
                start = time.perf_counter()
                run()
                if repetition >= 0:
                    seconds[name].append(time.perf_counter() - start)
    return {name: Timing(np.array(values)) for name, values in seconds.items()}


class Diversity:
    """Retains the last generations of a filter, to count their particles that still have descendants."""

    def __init__(self, filter_: Filter, back: int = GENERATIONS_BACK) -> None:
        self.filter = filter_
        self.back = back
        self.resampled = 0
        self.steps = 0
        self._kept: deque[int] = deque()
        self._retain()

    def after(self, resampled: bool) -> None:
        """Counts a step."""
        self.steps += 1
        if resampled:
            self.resampled += 1
            self._retain()

    def text(self) -> str:
        """Resampling rate, distinct ancestors and the stored fraction of the map."""
        lineage = self.filter.lineage
        age = lineage.generation - self._kept[0]
        landmark_map = self.filter.belief().map
        assert isinstance(landmark_map, LandmarkMap)
        store = landmark_map.store
        return (
            f"resampled {self.resampled}/{self.steps} steps, {lineage.distinct(self._kept[0])} distinct ancestors "
            f"{age} generations back, map stored/dense {store.stored_bytes / store.dense_bytes:.3f}"
        )

    def _retain(self) -> None:
        lineage = self.filter.lineage
        lineage.retain(lineage.generation)
        self._kept.append(lineage.generation)
        if len(self._kept) > self.back + 1:
            lineage.release(self._kept.popleft())
