"""What each pair of a run showed, kept small, so that pictures can be drawn after it and cost it no time."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

FEATURE, LANDMARK, TRIAL, NEW = range(4)
"""What a feature is: nothing to the map, a landmark that weighed the particles, a candidate, a candidate that was
started."""


@dataclass(frozen=True)
class PairSeen:
    """One pair.

    Attributes:
        z: (K, 3) pixels (u_left, v, u_right) of its features.
        kind: (K,) what each was.
    """

    z: np.ndarray
    kind: np.ndarray

    def of(self, kind: int) -> np.ndarray:
        """Pixels (k, 3) of one kind."""
        return np.asarray(self.z[self.kind == kind], dtype=float)


@final
class Seen:
    """All pairs so far."""

    def __init__(self) -> None:
        self._pairs: list[PairSeen] = []

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[PairSeen]:
        return iter(self._pairs)

    def __getitem__(self, t: int) -> PairSeen:
        return self._pairs[t]

    def record(self, z: np.ndarray, kind: np.ndarray) -> None:
        """The next pair."""
        self._pairs.append(PairSeen(z.astype(np.float32), kind.astype(np.int8)))

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {
            "seen/z": np.concatenate([np.zeros((0, 3), dtype=np.float32), *(p.z for p in self._pairs)]),
            "seen/kind": np.concatenate([np.zeros(0, dtype=np.int8), *(p.kind for p in self._pairs)]),
            "seen/counts": np.array([len(p.kind) for p in self._pairs], dtype=np.int64),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        cuts = np.cumsum(arrays["seen/counts"])[:-1]
        parts = (np.split(arrays[f"seen/{name}"], cuts) for name in ("z", "kind"))
        self._pairs = [PairSeen(z, kind) for z, kind in zip(*parts, strict=True)]
