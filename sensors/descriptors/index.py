"""The descriptors of a map: stored once for all particles, and found again in new images (S05 §III-B, §V).

Two searches stand side by side: `ExactSearch` compares every feature with every descriptor by one matrix product, which
is what S05 did; `TreeSearch` asks a k-d tree, which S05 names as the way to go on. Where it is predicted which landmarks
can be seen, and where, neither is needed: only the descriptors of near landmarks are compared, one by one (`Gate`).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.sensors.descriptors.matching import (
    DescriptorMatches,
    MatchLimits,
    decide,
    distances,
    gate_pairs,
    match_all,
    match_pairs,
    two_best,
)


@final
class DescriptorStore:
    """Descriptors of landmarks, which come and go.

    Args:
        length: of a descriptor.
    """

    def __init__(self, length: int) -> None:
        self.length = length
        self._descriptors = np.zeros((64, length), dtype=np.float32)
        self._ids = np.zeros(64, dtype=np.int64)
        self._count = 0
        self.restored = 0
        """How often the store was filled from a checkpoint: what was built on it before is void."""

    def __len__(self) -> int:
        return self._count

    @property
    def ids(self) -> np.ndarray:
        """(M,) ascending."""
        return self._ids[: self._count]

    @property
    def descriptors(self) -> np.ndarray:
        """(M, d) float32, in the order of the ids."""
        return self._descriptors[: self._count]

    def add(self, ids: np.ndarray, descriptors: np.ndarray) -> None:
        """Adds descriptors (k, d) of new landmarks (k,).

        Raises:
            InputError: the ids do not ascend beyond those held, or the descriptors have another length.
        """
        ids = np.asarray(ids, dtype=np.int64)
        if descriptors.shape != (ids.size, self.length):
            raise InputError(
                f"descriptors must be ({ids.size}, {self.length}), one for each id, got {descriptors.shape}"
            )
        last = self._ids[self._count - 1 : self._count]
        if (np.diff(np.concatenate([last, ids])) <= 0).any():
            raise InputError(
                "ids of new descriptors must ascend, and be above those held: take the map's own"
            )
        total = self._count + ids.size
        self._reserve(total)
        self._ids[self._count : total], self._descriptors[self._count : total] = ids, descriptors
        self._count = total

    def remove(self, ids: np.ndarray) -> None:
        """Drops landmarks (k,).

        Raises:
            InputError: one is not held.
        """
        rows = self.rows(ids)
        if not rows.size:
            return
        # What is removed is mostly young: only what follows the first of them moves.
        start = int(rows.min())
        kept = np.delete(np.arange(start, self._count), rows - start)
        total = start + kept.size
        self._ids[start:total], self._descriptors[start:total] = self._ids[kept], self._descriptors[kept]
        self._count = total

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Rows (k,) of landmarks (k,).

        Raises:
            InputError: one is not held.
        """
        ids = np.asarray(ids, dtype=np.int64)
        rows, held = self.find(ids)
        if not held.all():
            raise InputError(f"there is no descriptor of landmark {ids[~held][0]}")
        return rows

    def find(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k,) of landmarks (k,), and whether each is held (k,); the row of one that is not means nothing."""
        rows = np.minimum(np.searchsorted(self.ids, ids), max(self._count - 1, 0))
        return rows, (self.ids[rows] == ids) if self._count else np.zeros(rows.shape, dtype=bool)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {"descriptors/ids": self.ids.copy(), "descriptors/descriptors": self.descriptors.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._ids, self._descriptors = (
            arrays["descriptors/ids"].copy(),
            arrays["descriptors/descriptors"].copy(),
        )
        self._count, self.length = self._ids.size, self._descriptors.shape[1]
        self.restored += 1

    def _reserve(self, count: int) -> None:
        if count > self._ids.size:
            room = max(count, 2 * self._ids.size)
            ids, descriptors = np.zeros(room, dtype=np.int64), np.zeros((room, self.length), dtype=np.float32)
            ids[: self._count], descriptors[: self._count] = self.ids, self.descriptors
            self._ids, self._descriptors = ids, descriptors


NEAR = 3
"""Descriptors asked for: the two nearest, and one in case that one of them has gone."""


class DescriptorSearch(ABC):
    """Finds the descriptors of a store that are nearest to others."""

    @abstractmethod
    def match(self, query: np.ndarray, store: DescriptorStore, limits: MatchLimits) -> DescriptorMatches:
        """Matches descriptors (K, d) with those of the store, `second` are its rows."""


@final
class ExactSearch(DescriptorSearch):
    """Compares all with all."""

    def match(self, query: np.ndarray, store: DescriptorStore, limits: MatchLimits) -> DescriptorMatches:
        return match_all(query, store.descriptors, limits)


@final
class TreeSearch(DescriptorSearch):
    """Asks a k-d tree of a former state of the store, and compares with all descriptors that came since.

    The tree is made anew when many descriptors have come or gone. Those that have gone are left out of its answers; as S05 §V
    warns, they crowd it while they are there.

    Args:
        slack: a descriptor may be missed if another is at most 1 + slack times as far; 0 makes the search exact.
        tail: fraction of the tree's descriptors that may come or go before the tree is made anew.
        least: so many may come or go in any case.
    """

    def __init__(self, slack: float = 3.0, tail: float = 0.1, least: int = 500) -> None:
        if not (slack >= 0.0 and tail > 0.0 and least >= 0):
            expected = "a slack and a least of at least 0 and a positive tail"
            raise InputError(f"a tree search needs {expected}, got {slack}, {least} and {tail}")
        self.slack, self.tail, self.least = slack, tail, least
        self._ids = np.zeros(0, dtype=np.int64)
        self._tree: Any = None
        self._built: tuple[DescriptorStore, int] | None = None

    def match(self, query: np.ndarray, store: DescriptorStore, limits: MatchLimits) -> DescriptorMatches:
        if not query.shape[0] or not len(store):
            return match_all(query, store.descriptors, limits)
        rows, held = store.find(self._ids)
        young = len(store) - int(held.sum())
        stale = young + (~held).sum() > max(self.tail * self._ids.size, self.least)
        if stale or (store, store.restored) != self._built:
            self._build(store)
            rows, held, young = np.arange(len(store)), np.ones(len(store), dtype=bool), 0
        first = len(store) - young
        best, next_best, where = two_best(query, store.descriptors[first:])
        old = self._ask(query, limits, rows, held)
        merged = np.maximum(np.maximum(next_best, old[1]), np.minimum(best, old[0]))
        where = np.where(best > old[0], first + where, old[2])
        return decide(query, store.descriptors, (np.maximum(best, old[0]), merged, where), limits)

    def _ask(
        self, query: np.ndarray, limits: MatchLimits, rows: np.ndarray, held: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Products (K,) with the nearest and the next descriptor in the tree that are held still, and the nearest's row."""
        none = np.full(query.shape[0], -np.inf, dtype=np.float32)
        if not held.any():
            return none, none, np.zeros(query.shape[0], dtype=np.int64)
        near = min(NEAR, self._ids.size)
        # A descriptor further away is neither taken, nor does its distance forbid another.
        most = limits.largest(query.shape[1]) / limits.ratio * (1.0 + 1e-6)
        distance, found = self._tree.query(
            query, k=np.arange(1, near + 1), eps=self.slack, distance_upper_bound=most
        )
        there = np.isfinite(distance)
        found = np.where(there, found, 0)
        product = np.where(there & held[found], 1.0 - 0.5 * np.minimum(distance, 2.0) ** 2, -np.inf)
        product = product.astype(np.float32)
        order = np.argsort(-product, axis=1, kind="stable")
        product, found = np.take_along_axis(product, order, 1), np.take_along_axis(found, order, 1)
        return product[:, 0], product[:, 1] if near > 1 else none, rows[found[:, 0]]

    def _build(self, store: DescriptorStore) -> None:
        from scipy.spatial import cKDTree

        self._ids, self._built = store.ids.copy(), (store, store.restored)
        self._tree = cKDTree(store.descriptors, leafsize=32)


@final
@dataclass(frozen=True)
class Gate:
    """Which landmarks a prediction makes plausible for which feature.

    Attributes:
        z: (K, p) places of the features, (u, v) or (u_left, v, u_right).
        noise: (K, p, p) their covariances.
        ids: (V,) landmarks that should be in view; no others compete.
        mean: (V, p) where they should be, as `Belief.project` gives it.
        cov: (V, p, p) covariance of that, without the measurements' noise.
        gate: largest squared Mahalanobis distance; 11.3 holds 99 % of a Gaussian in three dimensions.
    """

    z: np.ndarray
    noise: np.ndarray
    ids: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    gate: float = 11.3


@final
@dataclass(frozen=True)
class MatchedLandmarks:
    """Landmarks of K features.

    Attributes:
        ids: (K,) the landmark of each, each landmark once; NULL where there is none.
        distance: (K,) of the descriptors, infinite where there is none.
    """

    ids: np.ndarray
    distance: np.ndarray


@final
class DescriptorIndex:
    """The descriptors of a map and how they are found.

    Args:
        length: of a descriptor, 36 or 128.
        limits: when a candidate is taken.
        search: of features about which nothing is predicted; exact by default.
    """

    def __init__(
        self, length: int, limits: MatchLimits | None = None, search: DescriptorSearch | None = None
    ) -> None:
        self.store = DescriptorStore(length)
        self.limits = limits or MatchLimits()
        self.search = search or ExactSearch()

    def match(self, descriptors: np.ndarray, gate: Gate | None = None) -> MatchedLandmarks:
        """The landmarks of features with descriptors (K, d).

        Args:
            descriptors: float32 of length 1.
            gate: what is predicted; None lets all landmarks compete for every feature.

        Raises:
            InputError: the descriptors have another length, or the gate names a landmark that is not held.
        """
        if descriptors.ndim != 2 or descriptors.shape[1] != self.store.length:
            raise InputError(f"descriptors must be (K, {self.store.length}), got {descriptors.shape}")
        if gate is None:
            matches = self.search.match(descriptors, self.store, self.limits)
        else:
            k, m = gate_pairs(gate.z, gate.noise, gate.mean, gate.cov, gate.gate)
            rows = self.store.rows(gate.ids)
            matches = match_pairs(descriptors, self.store.descriptors, (k, rows[m]), self.limits)
        ids, distance = (
            np.full(descriptors.shape[0], NULL, dtype=np.int64),
            np.full(descriptors.shape[0], np.inf),
        )
        ids[matches.first] = self.store.ids[matches.second]
        distance[matches.first] = matches.distance
        return MatchedLandmarks(ids, distance)

    def nearest(self, descriptors: np.ndarray) -> np.ndarray:
        """Distance (K,) of each descriptor (K, d) to the nearest one held, infinite where none is."""
        return distances(two_best(descriptors, self.store.descriptors)[0])
