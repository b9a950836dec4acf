"""The map's landmarks in the features of a stereo pair, and new ones (S05 §III-B, §V).

A landmark competes for a feature if it may be in view, its descriptor is like the feature's, and the particles expect it
there. Each feature is then one landmark's, the same for all particles, or has none: a null correspondence, which costs
all particles the same. Candidates, not seen often enough to be landmarks yet, are in the map, where they follow
each particle's path, without a say in the particles' weights.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import NULL, Belief, Likelihood, NewLandmarks, Observations, Part, Sensor
from rbpf.maps.point import Point
from rbpf.motion.stereo_vo import VoConfig, estimate_motion
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.camera.points import StereoPoint
from rbpf.sensors.catalogue_index import NumberIndex
from rbpf.sensors.descriptors.index import DescriptorIndex, Gate
from rbpf.sensors.descriptors.landmark_management import LandmarkManager, NewLandmarkConfig
from rbpf.sensors.stereo.features import StereoFeatures
from rbpf.systems.stereo.config import MapConfig
from rbpf.systems.stereo.landmarks import Places
from rbpf.systems.stereo.particle_subsample import Expected, ParticleSubsample
from rbpf.systems.stereo.seen import FEATURE, LANDMARK, NEW, TRIAL

_MAP = frozenset({Part.LANDMARK})

PROVEN = 2
"""Observations of a landmark that stands still: one that moves is not where it was seen first."""

TINY = 1e-6
"""Added to the variance of expected pixels, px²: a landmark may be known exactly."""


@dataclass(frozen=True)
class StereoFrame:
    """What the filter is updated by.

    Attributes:
        features: of the pair.
        free: (K,) which of them the map may use; None is all.
        doubt: the camera's motion was only assumed: matches with the map must agree on one motion, of landmarks that were
            found again before, and no new landmarks are started.
    """

    features: StereoFeatures
    free: np.ndarray | None = None
    doubt: bool = False


@final
class StereoSensor(Sensor):
    """Finds landmarks by their descriptors, starts candidates, and drops those that are not seen again.

    Args:
        rig: the cameras.
        config: how landmarks are matched.
        new_landmarks: which features become landmarks.
        length: of a descriptor.
        likelihood: of an innovation.
    """

    def __init__(
        self,
        rig: RectifiedStereo,
        config: MapConfig,
        new_landmarks: NewLandmarkConfig,
        length: int,
        likelihood: Likelihood,
    ) -> None:
        self.config = config
        self.likelihood = likelihood
        self.model = StereoPoint(rig)
        self.point = Point(3)
        self.index = DescriptorIndex(length, config.limits)
        self.manager = LandmarkManager(new_landmarks, (rig.camera.width, rig.camera.height))
        self.places = Places(rig, config)
        self.names = np.zeros(0, dtype=np.int64)
        """(K,) of the last pair's features, NULL where they are no landmark's."""
        self.seconds = 0.0
        """Time that matching the last pair took."""
        self._numbers = NumberIndex()

    def observe(self, frame: StereoFrame, belief: Belief) -> Sequence[Observations]:
        """The features that are landmarks, and those that are candidates."""
        started = time.perf_counter()
        features = frame.features
        self.names = np.full(len(features), NULL, dtype=np.int64)
        if self.config.used:
            self.names = self.matched(frame, belief)
        seen = self.names >= 0
        ids = np.full(seen.size, NULL, dtype=np.int64)
        ids[seen] = self.ids(belief, self.names[seen])
        weighing = self._weighing()
        groups = []
        for chosen, updates in ((weighing | ~seen, None), (seen & ~weighing, _MAP)):
            if (ids[chosen] >= 0).any():
                groups.append(self._group(features.take(chosen), ids[chosen], updates))
        self.seconds = time.perf_counter() - started
        return groups

    def new_landmarks(
        self, frame: StereoFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """Counts what was seen, drops candidates that were not seen again, starts new ones."""
        if not self.config.used:
            return []
        seen = self.names >= 0
        self._forget(belief, self.manager.observe(self.names[seen]))
        self._place(belief, self.names[seen])
        if frame.doubt:
            return []
        rows = self._worth_a_landmark(frame, seen)
        if not rows.size:
            return []
        features = frame.features.take(rows)
        names = self.manager.add(rows.size)
        self.index.store.add(names, features.descriptors)
        pose = belief.state[belief.mode]
        self.places.put(names, self.model.invert(pose, features.z), pose)
        self.names[rows] = names
        return [NewLandmarks(features.z, features.cov, self.model, self.point, facts=names.tolist())]

    def ids(self, belief: Belief, names: np.ndarray) -> np.ndarray:
        """The map's numbers (k,) of landmarks (k,)."""
        return self._numbers.ids(belief.catalogue, names)

    def proven(self) -> np.ndarray:
        """Names (M,) of the landmarks that were found again where the map has them: these stand still."""
        return np.asarray(self.manager.names[self.manager.observations >= PROVEN])

    def kinds(self) -> np.ndarray:
        """What each feature (K,) of the last pair was to the map, see `rbpf.systems.stereo.seen`."""
        manager = self.manager
        out = np.full(self.names.size, FEATURE)
        rows = np.searchsorted(manager.names, self.names)
        held = np.flatnonzero(rows < manager.names.size)
        held = held[manager.names[rows[held]] == self.names[held]]
        rows = rows[held]
        out[held] = np.where(manager.confirmed[rows], LANDMARK, TRIAL)
        out[held[manager.observations[rows] == 1]] = NEW
        return out

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return self.index.store.arrays() | self.manager.arrays() | self.places.arrays()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self.index.store.restore(arrays)
        self.manager.restore(arrays)
        self.places.restore(arrays)

    def _group(
        self, features: StereoFeatures, ids: np.ndarray, updates: frozenset[Part] | None
    ) -> Observations:
        null = self.likelihood.log_outlier()
        if updates is None:
            return Observations(features.z, features.cov, self.model, self.likelihood, ids, log_clutter=null)
        return Observations(features.z, features.cov, self.model, self.likelihood, ids, updates=updates)

    def _weighing(self) -> np.ndarray:
        """Features (K,) of landmarks, this observation included, that weigh the particles."""
        if self.config.weigh == "all":
            return self.names >= 0
        manager = self.manager
        often = manager.observations + 1 >= manager.config.observations
        return np.isin(self.names, manager.names[often])

    def matched(self, frame: StereoFrame, belief: Belief) -> np.ndarray:
        """Name of each feature's landmark (K,), NULL where it has none."""
        features = frame.features
        out = np.full(len(features), NULL, dtype=np.int64)
        rows = np.arange(len(features)) if frame.free is None else np.flatnonzero(frame.free)
        subsample = ParticleSubsample.of(belief, self.config.subsample)
        names = self._alike(features.descriptors[rows], subsample)
        if frame.doubt:
            names = names[np.isin(names, self.proven())]
        if not (names.size and rows.size):
            return out
        ids = self.ids(belief, names)
        seen = subsample.expected(belief, self.model, ids)
        total = seen.cov + self.config.slack_px**2 * np.eye(3)
        gate = Gate(features.z[rows], features.cov[rows], names, seen.mean, total, self.config.gate)
        found = self.index.match(features.descriptors[rows], gate).ids
        taken = np.flatnonzero(found >= 0)
        of = np.searchsorted(names, found[taken])
        agreed = self._agreed(seen.take(of), features.take(rows[taken]), frame.doubt)
        out[rows[taken[agreed]]] = found[taken[agreed]]
        return out

    def log_support(self, frame: StereoFrame, belief: Belief) -> float:
        """How well landmarks are seen: their log-density beside that of features of unknown things.

        Candidates have no say: they may be of what moves.
        """
        names = self.matched(frame, belief)
        rows = np.flatnonzero(np.isin(names, self.proven()))
        if not rows.size:
            return 0.0
        features, ids = frame.features.take(rows), self.ids(belief, names[rows])
        seen = ParticleSubsample.of(belief, self.config.subsample).expected(belief, self.model, ids)
        return log_support(features.z - seen.mean, features.cov + seen.cov, frame.features.z, self.model.rig)

    def _agreed(self, seen: Expected, features: StereoFeatures, doubt: bool) -> np.ndarray:
        """Which matches (k,) are taken: all, unless they are expected so vaguely that the gate tells little."""
        all_of_them = np.ones(len(features), dtype=bool)
        vague = doubt or (len(features) and np.median(seen.deviation) > self.config.doubt_px)
        if not vague:
            return all_of_them
        if len(features) < self.config.agreeing:
            return ~all_of_them
        # As the heaviest particle sees them, moved by an increment of any size.
        motion = estimate_motion(
            self.model.rig,
            seen.by_heaviest,
            features.z,
            seen.within + TINY * np.eye(3),
            features.cov,
            np.random.default_rng(self.manager.frame),
            config=VoConfig(least_matches=self.config.agreeing),
        )
        return motion.inliers

    def _alike(self, descriptors: np.ndarray, subsample: ParticleSubsample) -> np.ndarray:
        """Names of landmarks that may be in view and whose descriptors come near to that of any feature, ascending.

        Descriptors further away are neither taken nor forbid others by the ratio, whatever is expected where.
        """
        store, limits = self.index.store, self.config.limits
        names = self.places.in_view(store.ids, subsample.middle, subsample.doubt_rad)
        if not names.size or not descriptors.shape[0]:
            return names[:0]
        most = limits.largest(store.length) / limits.ratio
        near = (descriptors @ store.descriptors[store.rows(names)].T).max(axis=0) >= 1.0 - 0.5 * most**2
        return np.asarray(names[near])

    def _forget(self, belief: Belief, names: np.ndarray) -> None:
        if names.size:
            belief.map.remove(self.ids(belief, names))
            self.index.store.remove(names)

    def _place(self, belief: Belief, names: np.ndarray) -> None:
        """Notes where the heaviest particle has landmarks now."""
        if names.size:
            ids = self.ids(belief, names)
            mode = belief.mode
            self.places.put(names, belief.read(ids, np.array([mode])).mean[0], belief.state[mode])

    def _worth_a_landmark(self, frame: StereoFrame, seen: np.ndarray) -> np.ndarray:
        """Rows of features that start landmarks."""
        features = frame.features
        able = ~seen & self._deep(features)
        if frame.free is not None:
            able &= frame.free
        rows = np.flatnonzero(able)
        if not rows.size:
            return rows
        nearest = self.index.nearest(features.descriptors[rows])
        chosen = self.manager.select(
            features.z[rows, :2], features.descriptors[rows], nearest, features.z[seen, :2]
        )
        return rows[chosen]

    def _deep(self, features: StereoFeatures) -> np.ndarray:
        """Whether the depth of features is known well enough for a Gaussian in space, (K,)."""
        return np.sqrt(features.cov_points[:, 2, 2]) <= self.config.depth_fraction * features.points[:, 2]


def log_support(nu: np.ndarray, cov: np.ndarray, z: np.ndarray, rig: RectifiedStereo) -> float:
    """Σ max(log N(ν; 0, S) − log λ, 0) of features (k,) that are taken for landmarks: each is, or is so by chance.

    Args:
        nu: (k, 3) innovations, px.
        cov: (k, 3, 3) S, px².
        z: (K, 3) of all features of the pair, which are λ per px³ where they may be.
        rig: the cameras.
    """
    depths = max(float(np.ptp(z[:, 0] - z[:, 2])), 1.0)
    density = len(z) / (rig.camera.width * rig.camera.height * depths)
    return float(np.maximum(gaussian.log_density(nu, cov) - np.log(density), 0.0).sum())
