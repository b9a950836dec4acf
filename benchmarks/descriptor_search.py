"""Matching features with a map's descriptors by a matrix product, or gated by predicted positions; on one thread."""

from collections.abc import Callable

import cv2
import numpy as np

from benchmarks.patch_search import one_thread, picture
from benchmarks.rows import Row, Settings, Timing, interleaved
from rbpf.sensors.descriptors import MatchLimits, gate_pairs, match_all, match_pairs
from rbpf.sensors.features import Sift, SiftConfig

SIZES, FEATURES, IN_VIEW = (1000, 10_000, 40_000), 300, 600
LENGTH, NOISE = 36, 0.012
"""Noise per entry: descriptors of one point are 0.06 to 0.1 apart in recordings."""


def real_descriptors(count: int) -> np.ndarray:
    """SIFT descriptors (count, 36) of noise smoothed at several scales."""
    sift, descriptors, size = Sift(SiftConfig(0, 1.0, contrast=0.02)), [], 0
    while size < count:
        image = picture(480, 640, 1.5 + 0.1 * len(descriptors), seed=len(descriptors))
        descriptors.append(sift.extract(image).descriptors)
        size += len(descriptors[-1])
    return np.concatenate(descriptors)[:count]


class Map:
    """A map of descriptors, and features, five in six of which are in it."""

    def __init__(self, descriptors: np.ndarray) -> None:
        rng, count = np.random.default_rng(0), len(descriptors)
        self.descriptors = descriptors
        seen, absent = rng.permutation(count)[:FEATURES], FEATURES // 6
        query = descriptors[seen] + NOISE * rng.standard_normal((FEATURES, LENGTH)).astype(np.float32)
        query[:absent] = np.abs(rng.standard_normal((absent, LENGTH)))
        self.query = (query / np.linalg.norm(query, axis=1, keepdims=True)).astype(np.float32)
        self.ids = np.union1d(seen, rng.permutation(count)[: IN_VIEW - FEATURES])
        mean = rng.uniform([0, 0, 0], [640, 480, 640], (count, 3))
        cov = np.tile(25.0 * np.eye(3), (self.ids.size, 1, 1))
        z = mean[seen] + rng.standard_normal((FEATURES, 3))
        self.gate = z, np.tile(np.eye(3), (FEATURES, 1, 1)), mean[self.ids], cov, 11.3
        self.matcher = cv2.BFMatcher(cv2.NORM_L2)

    def contestants(self) -> dict[str, Callable[[], object]]:
        """Contestants by name."""
        return {
            "exact": lambda: match_all(self.query, self.descriptors, MatchLimits()),
            "gated": self.gated,
            "peer": lambda: self.matcher.knnMatch(self.query, self.descriptors, 2),
        }

    def gated(self) -> object:
        """Compares each feature only with landmarks predicted near it."""
        k, m = gate_pairs(*self.gate)
        return match_pairs(self.query, self.descriptors, (k, self.ids[m]), MatchLimits())


def run(settings: Settings) -> list[Row]:
    """One row per size of the map, and one for the largest with gating."""
    descriptors, rows = real_descriptors(max(SIZES)), []
    with one_thread():
        for size in SIZES:
            task = Map(descriptors[:size])
            times = interleaved(task.contestants(), settings.repetitions(15))
            peer = "cv2.BFMatcher.knnMatch"
            rows.append(row(f"descriptors of a map of {size}, exact", times, "exact", "peer", peer))
    notes = f"{IN_VIEW} landmarks in view, predicted to 5 px"
    rows.append(row(f"descriptors of a map of {max(SIZES)}, gated", times, "gated", "exact", "exact", notes))
    return rows


def row(name: str, times: dict[str, Timing], ours: str, other: str, baseline: str, notes: str = "") -> Row:
    """A row of milliseconds, with another contestant as baseline."""
    figure, theirs = times[ours].median * 1e3, times[other].median * 1e3
    return Row(
        name,
        figure,
        "ms",
        baseline,
        theirs,
        theirs / figure,
        notes=f"{FEATURES} features, descriptors of {LENGTH}; {notes + '; ' if notes else ''}{times[ours].spread}",
        tolerance=0.5,
    )
