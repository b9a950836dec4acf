"""The descriptors of a map: stored once for all particles, and found again in new images (S05 §III-B, §V).

Two searches stand side by side: `ExactSearch` compares every feature with every descriptor by one matrix product, which is
what S05 did; `TreeSearch` asks a k-d tree, which S05 names as the way to go on. Where it is predicted which landmarks
can be seen, and where, neither is needed: only the descriptors of near landmarks are compared, one by one (`Gate`).
"""

from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.core.exchange import NULL
from rbpf.errors import InputError
from rbpf.sensors.candidates import gate_pairs
from rbpf.sensors.descriptor_matching import MatchLimits, distances, match_pairs, two_best
from rbpf.sensors.descriptor_search import DescriptorSearch, ExactSearch
from rbpf.sensors.descriptor_store import DescriptorStore


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
