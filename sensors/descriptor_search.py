"""Searches among the descriptors of a map: of all by a matrix product, and of the nearest by a k-d tree."""

from abc import ABC, abstractmethod
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.descriptor_matching import DescriptorMatches, MatchLimits, decide, match_all, two_best
from rbpf.sensors.descriptor_store import DescriptorStore

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
