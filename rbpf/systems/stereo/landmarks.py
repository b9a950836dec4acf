"""Data association of stereo features with the map's landmarks, and new landmarks (S05 §III-B, §V).

A landmark is a candidate for a feature if it may be in view, their descriptors are similar, and the feature is within the
gate of its prediction. Each feature is then associated with one landmark, the same in all particles, or with none: a null
correspondence, which costs all particles the same. Landmarks that have not been observed often enough are candidates: they
are in the map and are updated, but do not weigh the particles.

`DescriptorLandmarks` associates by SIFT descriptors; known association is in `named_pixels.py`.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import partial
from typing import Any, Generic, Protocol, Self, TypeVar, final

import numpy as np

from rbpf import gaussian
from rbpf.arrays import RowByRow
from rbpf.core.models import NULL, Belief, Landmark, NewLandmarks, Observations, Sensor
from rbpf.core.particles import Particles, Prior
from rbpf.errors import InputError
from rbpf.gaussian import symmetrise
from rbpf.lie import SE3
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.maps.rows import MAP
from rbpf.motion.stereo_geometry import Matches
from rbpf.motion.stereo_vo import VoConfig, estimate_motion
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.camera.points import CameraModel, StereoPoint
from rbpf.sensors.descriptors import gate_pairs, match_pairs
from rbpf.sensors.landmark_management import LandmarkManager
from rbpf.sensors.stereo import StereoFeatures, aligned
from rbpf.systems.learnt_noise import LearntNoise
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.places import Places, make_room, places_of
from rbpf.systems.system import MAP_IDS

SEEN_AGAIN = 2  #: Observations that show that a landmark is static.
TINY = 1e-6  #: Added to the variance of predicted pixels, px², as a landmark may be known exactly.


class FeatureKind(IntEnum):
    """Role of a feature in the map."""

    FEATURE = 0  #: not associated.
    LANDMARK = 1  #: a landmark that weighed the particles.
    CANDIDATE = 2  #: a landmark not observed often enough to weigh them.
    NEW = 3  #: a new landmark initialised by it.


class PairFeatures(Protocol):
    """Features measured by a front end in a pair.

    Pixels z (K, 3) (u_left, v, u_right), and the covariance (K, 3, 3) of their noise, px².
    """

    @property
    def z(self) -> np.ndarray: ...
    @property
    def cov(self) -> np.ndarray: ...
    def __len__(self) -> int: ...
    def take(self, rows: np.ndarray) -> Self:
        """Some of them, by number or by mask."""


F = TypeVar("F", bound=PairFeatures)


@final
@dataclass(frozen=True, eq=False)
class Pair(Generic[F]):
    """The features of one frame; for association and the filter's update without those on moving objects."""

    stamp_ns: int
    features: F  #: K of them.
    for_odometry: np.ndarray  #: (K,) bool, which the odometry may use.
    for_map: np.ndarray  #: (K,) bool, which the map may use.
    labels: np.ndarray  #: (K,) whether each was static, see `rbpf.systems.stereo.motion_segmentation`.
    #: whether the camera's motion was only assumed: associations must then agree on one motion, of re-observed landmarks, and
    #: no landmark is initialised.
    uncertain: bool = False
    #: (K,) landmark of each feature, or NULL; None before association.
    landmarks: np.ndarray | None = None
    starts: np.ndarray | None = None  #: rows of features that initialise landmarks; None before they are selected.
    #: left and right image, for the alignment of re-observed points; or None.
    images: tuple[np.ndarray, np.ndarray] | None = None
    offset_px: float = 0.0  #: offset of the right image's columns, already subtracted from the features.

    def __len__(self) -> int:
        return len(self.features)


class Landmarks(Sensor, ABC, Generic[F]):
    """Associates features with landmarks, and initialises new ones. A subclass implements the recognition."""

    rig: RectifiedStereo
    model: CameraModel  #: observation model of a landmark.
    landmark: Landmark  #: its parametrisation.
    ids: np.ndarray  #: (K,) landmark of each feature of the last update's pair, or NULL.
    seconds: float = 0.0  #: time of the association.
    noise: LearntNoise | None = None  #: learnt noise factor of the features, or None.

    @abstractmethod
    def associate(self, pair: Pair[F], belief: Belief) -> np.ndarray:
        """Landmark (K,) of each feature, or NULL."""

    def put_away(self, pair: Pair[F], belief: Belief, joint: JointMap, free: np.ndarray) -> np.ndarray:
        """For features in the mask `free` (K,) their landmark (K,) among those put away by a joint map; by default NULL."""
        return np.full(len(pair), NULL, dtype=np.int64)

    def left_over(self, pair: Pair[F]) -> tuple[Pair[F], np.ndarray]:
        """The pair with `starts` set, and a mask (K,) of features that the map does not use; by default none."""
        return pair, np.zeros(len(pair), dtype=bool)

    def told(self, pair: Pair[F]) -> F:
        """The features of the last update's pair, as used by the filter; by default as measured."""
        return pair.features

    @abstractmethod
    def seen_again(self) -> np.ndarray:
        """(M,) landmarks that were re-observed consistently: they are static and usable for relocalisation."""

    def expected(self, belief: Belief, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicted measurements of landmarks (k,): (k, 3) and covariance (k, 3, 3) without the measurement noise."""
        return belief.project(self.model, ids)

    def kinds(self) -> np.ndarray:
        """(K,) `FeatureKind` of each feature of the last update's pair; by default all are landmarks."""
        return np.full(self.ids.size, FeatureKind.LANDMARK)

    def confirmed_static(self) -> np.ndarray:
        """Rows of that pair's features that are consistent with the map, and thus static. By default none."""
        return np.zeros(0, dtype=np.intp)

    def columns(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        """Further columns on landmarks (M,), (M,) by name."""
        return {}

    def counts(self, held: int) -> dict[str, float | int]:
        """Entries of summary.json: SIFT features ever initialised, and landmarks, given the number `held` in the map."""
        return {"sift_features": 0, "landmarks_mean_per_particle": float(held)}

    def match_globally(self, pair: Pair[F]) -> np.ndarray:
        """Landmark (K,) of each feature, regardless of predictions; NULL for none, by default for all."""
        return np.full(len(pair), NULL, dtype=np.int64)

    def log_support(self, pair: Pair[F], belief: Belief) -> float:
        """Log-likelihood ratio of the features matched to predicted landmarks, against unknown features.

        Candidates that were never re-observed are ignored: they may be on moving objects.
        """
        ids = self.associate(pair, belief)
        rows = np.flatnonzero(np.isin(ids, self.seen_again()))
        if not rows.size:
            return 0.0
        features, (mean, cov) = pair.features.take(rows), self.expected(belief, ids[rows])
        z = pair.features.z[pair.for_map]
        return log_support(features.z - mean, features.cov + cov, z, self.rig)

    def relocalised(self, pair: Pair[F], belief: Belief, config: VoConfig) -> tuple[np.ndarray, int] | None:
        """Global relocalisation in the map by the features' appearance, without a prediction.

        Some matches by appearance are wrong, so they must agree on one pose. The consensus search is that of visual odometry;
        the map replaces the earlier pair, projected to a virtual camera far enough back to have all matched landmarks in
        front of it.

        Returns:
            world_from_camera (7,) in the world of the heaviest particle, and the number of inliers; None with too few.
        """
        ids = self.match_globally(pair)
        rows = np.flatnonzero(np.isin(ids, self.seen_again()))
        if rows.size < config.min_matches:
            return None
        features, (place, cov) = pair.features.take(rows), places_of(belief, ids[rows])
        middle = np.median(place, axis=0)
        far = np.linalg.norm(place - middle, axis=1).max()
        world_from_view = SE3.identity()
        world_from_view[4:] = middle - [0.0, 0.0, 2.0 * far]
        local = SE3.inverse_transform(world_from_view, place)
        slope = self.rig.jacobian(local)
        cov_seen = symmetrise(slope @ cov @ slope.mT) + TINY * np.eye(3)
        matches = Matches.checked(self.rig, self.rig.project(local), features.z, cov_seen, features.cov)
        found = estimate_motion(matches, belief.rng, config=config)
        if not found.found:
            return None
        return SE3.compose(world_from_view, found.previous_camera_from_camera), int(found.inliers.sum())

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""

    @abstractmethod
    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""


def log_support(nu: np.ndarray, cov: np.ndarray, z: np.ndarray, rig: RectifiedStereo) -> float:
    """Σ max(log N(ν; 0, S) − log λ, 0) of features (k,) matched to landmarks: each match is right, or is by chance.

    Innovations are ν (k, 3) and S (k, 3, 3), px; λ is the density of the pair's features z (K, 3) per px³.
    """
    depths = max(float(np.ptp(z[:, 0] - z[:, 2])), 1.0)
    density = len(z) / (rig.camera.width * rig.camera.height * depths)
    return float(np.maximum(gaussian.log_density(nu, cov) - np.log(density), 0.0).sum())


@dataclass(frozen=True)
class Expected(RowByRow):
    """Predictions of K landmarks in (u_left, v, u_right), px."""

    mean: np.ndarray  #: (K, 3) over the particles.
    cov: np.ndarray  #: (K, 3, 3) within and between particles, without the noise of a measurement.
    within: np.ndarray  #: (K, 3, 3) of the landmark in the heaviest particle, given its pose.
    by_heaviest: np.ndarray  #: (K, 3) prediction of that particle.

    @property
    def deviation(self) -> np.ndarray:
        """(K,) largest standard deviation along an axis."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2).max(axis=1))


@final
@dataclass(frozen=True)
class ParticleSubsample:
    """A few particles of equal weight, sampled systematically, and the heaviest one last."""

    rows: np.ndarray  #: (n + 1,) their indices.
    prior: Prior  #: their distribution before the observations.
    middle: np.ndarray  #: (7,) their mean world_from_camera.
    std_direction_rad: float  #: standard deviation of the camera's direction.

    @classmethod
    def of(cls, belief: Belief, count: int) -> "ParticleSubsample":
        """At most `count` of them."""
        weights = belief.weights
        steps = (np.arange(min(count, weights.size)) + 0.5) / min(count, weights.size)
        rows = np.minimum(np.searchsorted(np.cumsum(weights), steps), weights.size - 1)
        rows = np.append(rows, belief.mode)
        prior = belief.prior.take(rows)
        state = belief.map.world(prior.predicted(), rows)
        middle = SE3.mean(state[:-1], np.full(rows.size - 1, 1.0 / (rows.size - 1)))
        turns = SE3.local(middle, state[:-1])[:, :3]
        spread = prior.spread(prior.mean)[-1, :3]
        variance = np.square(turns).mean(axis=0) + np.square(spread).sum(axis=1)
        return cls(rows, prior, middle, float(np.sqrt(variance.max())))

    def expected(self, belief: Belief, model: CameraModel, ids: np.ndarray) -> Expected:
        """Predictions of landmarks (K,).

        The covariance within a particle is nearly equal for all, so that of the heaviest one is used.
        """
        records, state = belief.read(ids, self.rows), self.prior.predicted()
        px = model.predict(state[:, None], records.mean, records.const)
        const = None if records.const is None else records.const[-1]
        jac = model.jacobians(state[-1], records.mean[-1], const)
        assert jac.state is not None and jac.landmark is not None
        moved = jac.state @ self.prior.spread(self.prior.mean)[-1]
        within = symmetrise(jac.landmark @ records.cov[-1] @ jac.landmark.mT)
        mean = px[:-1].mean(axis=0)
        off = px[:-1] - mean
        between = np.einsum("nka,nkb->kab", off, off) / off.shape[0]
        return Expected(mean, symmetrise(within + moved @ moved.mT + between), within, px[-1])


class AssociationGate(ABC):
    """Gates candidate pairs of features and landmarks by their predictions; descriptors decide among them."""

    @abstractmethod
    def pairs(self, features: StereoFeatures, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
        """Rows (C,) of features and (C,) of landmarks that may match."""


@final
class MahalanobisGate(AssociationGate):
    """Features within a squared Mahalanobis distance `gate`; `slack_px` adds to the expected standard deviation per axis."""

    def __init__(self, gate: float, slack_px: float) -> None:
        self.gate, self.slack_px = gate, slack_px

    def pairs(self, features: StereoFeatures, expected: Expected) -> tuple[np.ndarray, np.ndarray]:
        cov = expected.cov + self.slack_px**2 * np.eye(3)
        return gate_pairs(features.z, features.cov, expected.mean, cov, self.gate)


class DescriptorLandmarks(Landmarks[StereoFeatures]):
    """Associates landmarks by descriptors, and manages them.

    Args:
        rig: the cameras.
        config: all settings.
        length: of a descriptor.
        gate, model, landmark: see `rbpf.systems.stereo.slam.StereoSlam`.
    """

    def __init__(
        self,
        rig: RectifiedStereo,
        config: StereoConfig,
        length: int,
        gate: AssociationGate | None = None,
        model: CameraModel | None = None,
        landmark: Landmark | None = None,
    ) -> None:
        self.rig, self.config, self._matching, self.likelihood = rig, config.map, config.pair, config.likelihood.build()
        self.gate = gate or MahalanobisGate(self.config.gate, self.config.slack_px)
        self.model, self.landmark = model or StereoPoint(rig), landmark or Point(3)
        self.manager = LandmarkManager(config.new_landmarks, (rig.camera.width, rig.camera.height), length)
        self.places = Places(rig, self.config)
        self.noise = LearntNoise() if self.config.kind == "joint" else None
        self.ids = np.zeros(0, dtype=np.int64)
        self._told: StereoFeatures

    def observe(self, frame: Pair[StereoFeatures], belief: Belief) -> Sequence[Observations]:
        """Observations of landmarks, and of candidates."""
        started = time.perf_counter()
        self.ids = self.associate(frame, belief) if frame.landmarks is None else frame.landmarks
        self._told = features = self._aligned(frame)
        known = self.ids >= 0
        weighs = known
        if self.config.weigh != "all" and self.config.kind != "joint":
            # This observation confirms them.
            often = self.manager.observations + 1 >= self.manager.config.observations
            weighs = np.isin(self.ids, self.manager.names[often])
        if self.noise is not None and known.any():
            # A keypoint's point on the object drifts as the view changes, between observations by as much as its noise.
            held, ids = belief.map, self.ids[known]
            assert isinstance(held, JointMap)
            local = SE3.inverse_transform(belief.state[belief.mode], belief.read_mode(ids).mean[0])
            far = np.linalg.norm(local, axis=1) / self.rig.camera.fx
            variance = self.noise.factor(ids) * features.cov[known, 1, 1] * far**2
            held.loosen(ids, variance[:, None, None] * np.eye(3))
        groups = []
        # Candidates are updated, but do not weigh; features without a landmark are null correspondences in all particles.
        for chosen, options in (
            (weighs | ~known, {"log_clutter": self.likelihood.log_outlier()}),
            (known & ~weighs, {"updates": MAP}),
        ):
            if (self.ids[chosen] >= 0).any():
                part: dict[str, Any] = {"ids": self.ids[chosen], **options}
                z, cov = features.z[chosen], features.cov[chosen]
                if self.noise is not None:
                    cov = cov * self.noise.factor(self.ids[chosen])[:, None, None]
                groups.append(Observations(z, cov, self.model, self.likelihood, **part))
        self.seconds = time.perf_counter() - started
        return groups

    def new_landmarks(
        self, frame: Pair[StereoFeatures], belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """Counts observations, drops candidates that were not re-observed, and initialises new ones."""
        known = self.ids >= 0
        seen = self.ids[known]
        if self.noise is not None:
            held = belief.map
            assert isinstance(held, JointMap)
            for group in observed:
                self.noise.learn_from(group, partial(held.expected_alone, self.model, belief))
        dropped, rows = self.manager.observe(seen)
        if dropped.size:
            belief.map.remove(dropped)
            self.places.remove(rows)
            if self.noise is not None:
                self.noise.remove(dropped)
        # Positions are in the world; the particles' states and landmarks may be in another frame.
        mode = belief.state[belief.mode]
        pose = belief.map.world(mode[None], np.array([belief.mode]))[0]
        if seen.size:
            records = belief.read_mode(seen)
            place = self.landmark.homogeneous(records.mean, records.const)[0]
            place = place[:, :3] / place[:, 3:]
            self.places.put(self.manager.rows(seen), SE3.transform(pose, SE3.inverse_transform(mode, place)), pose)
        # Candidates that are not re-observed are dropped anyway.
        confirmed = self.manager.confirmed
        make_room(belief.map, self.manager.names[confirmed], self.manager.unseen_for[confirmed])
        if frame.uncertain:
            return []
        rows = self._starts(frame, known, self.manager) if frame.starts is None else frame.starts
        if not rows.size:
            return []
        features = frame.features.take(rows)
        # The manager numbers landmarks like the map.
        ids = self.manager.add(features.descriptors)
        self.places.add(features.patch, features.first)
        self.places.put(self.manager.rows(ids), SE3.transform(pose, features.points), pose)
        self.ids[rows] = ids
        cov = features.cov
        if self.noise is not None:
            cov = cov * self.noise.factor(ids)[:, None, None]
        return [NewLandmarks(features.z, cov, self.model, self.landmark, ids=ids)]

    def _starts(self, pair: Pair[StereoFeatures], known: np.ndarray, manager: LandmarkManager) -> np.ndarray:
        """Rows of features whose depth is precise enough for a Gaussian in space, selected by the manager."""
        features = pair.features
        deep = np.sqrt(features.cov_points[:, 2, 2]) <= self.config.depth_fraction * features.points[:, 2]
        rows = np.flatnonzero(~known & deep & pair.for_map)
        if not rows.size:
            return rows
        descriptors, px = features.descriptors[rows], features.z[:, :2]
        return rows[manager.select(px[rows], descriptors, manager.nearest(descriptors), px[known])]

    def told(self, pair: Pair[StereoFeatures]) -> StereoFeatures:
        return self._told

    def _aligned(self, pair: Pair[StereoFeatures]) -> StereoFeatures:
        """The pair's features, those of landmarks aligned with their first views."""
        features, rows = pair.features, np.flatnonzero(self.ids >= 0)
        if pair.images is None or not (rows.size and features.patch.size):
            return features
        held = self.manager.rows(self.ids[rows])
        patch, first = self.places.patch[held], self.places.first[held]
        # Most are already aligned, by tracking from pair to pair.
        moves = (first != features.first[rows]).any(axis=1) | (patch != features.patch[rows]).any(axis=(1, 2))
        which = rows[moves], patch[moves], first[moves]
        return aligned(self.rig, self._matching, pair.images, pair.offset_px, features, *which)

    def left_over(self, pair: Pair[StereoFeatures]) -> tuple[Pair[StereoFeatures], np.ndarray]:
        assert pair.landmarks is not None
        free, manager = pair.landmarks == NULL, self.manager.copied()
        manager.observe(pair.landmarks[~free])  # confirmed and dropped ones make room for new ones
        pair = replace(pair, starts=self._starts(pair, ~free, manager))
        free[pair.starts] = False
        return pair, free

    def associate(self, pair: Pair[StereoFeatures], belief: Belief) -> np.ndarray:
        """By descriptors, within the gate of their predictions."""
        out = np.full(len(pair), NULL, dtype=np.int64)
        rows = np.flatnonzero(pair.for_map)
        features = pair.features.take(rows)
        subsample = ParticleSubsample.of(belief, self.config.subsample)
        near = self.places.in_view(subsample.middle, subsample.std_direction_rad)
        held, limits = self.manager, self.config.limits
        if near.size and rows.size:
            # More distant descriptors neither match nor count in the ratio test, whatever the prediction.
            most = limits.largest(held.length) / limits.ratio
            products = features.descriptors @ held.descriptors[near].T
            near = near[products.max(axis=0) >= 1.0 - 0.5 * most**2]
        ids = held.names[near]
        ids = ids[belief.map.holds(ids)]
        if pair.uncertain:
            ids = ids[np.isin(ids, self.seen_again())]
        if not (ids.size and rows.size):
            return out
        expected = subsample.expected(belief, self.model, ids)
        k, m = self.gate.pairs(features, expected)
        found = match_pairs(features.descriptors, held.descriptors, (k, held.rows(ids)[m]), limits)
        taken = held.names[found.second]
        agreed = self._accepted(
            expected.take(np.searchsorted(ids, taken)), features.take(found.first), pair.uncertain, belief.rng
        )
        out[rows[found.first[agreed]]] = taken[agreed]
        return out

    def put_away(self, pair: Pair[StereoFeatures], belief: Belief, joint: JointMap, free: np.ndarray) -> np.ndarray:
        """By descriptors, within the view from all poses that the camera may have in the world.

        Those not around the start of the current sub-map must agree on one motion, as they trigger a joint solution.
        """
        (old, places), held, prior = joint.old.places(), self.manager, belief.prior
        away, rows = ~joint.holds(old), np.flatnonzero(pair.for_map & free)
        out, features = np.full(len(pair), NULL, dtype=np.int64), pair.features.take(rows)
        self.places.move(held.rows(old[away]), places[away])
        camera, spread = joint.estimate(Particles(prior.predicted(), belief.log_weights)), prior.spread(prior.mean)[-1]
        cov = camera.cov + spread @ spread.T
        at = self.places.in_view(camera.mean, float(np.sqrt(np.diagonal(cov)[:3].max())))
        at = at[np.isin(held.names[at], old[away])]
        if not (at.size and len(features)):
            return out
        px = self.model.predict(camera.mean, self.places.place[at])
        slope = self.model.jacobians(camera.mean, self.places.place[at]).state
        assert slope is not None
        own = np.tile(self.config.slack_px**2 * np.eye(3), (at.size, 1, 1))
        expected = Expected(px, symmetrise(slope @ cov @ slope.mT), own, px)
        near = self.gate.pairs(features, expected)
        found = match_pairs(features.descriptors, held.descriptors[at], near, self.config.limits)
        taken = held.names[at[found.second]]
        far = np.flatnonzero(~np.isin(taken, joint.old.about.ids))
        agreed = np.ones(len(found), dtype=bool)
        agreed[far] = self._accepted(
            expected.take(found.second[far]), features.take(found.first[far]), True, belief.rng
        )
        out[rows[found.first[agreed]]] = taken[agreed]
        return out

    def match_globally(self, pair: Pair[StereoFeatures]) -> np.ndarray:
        """By descriptors alone."""
        out = np.full(len(pair), NULL, dtype=np.int64)
        rows = np.flatnonzero(pair.for_map)
        out[rows] = self.manager.match(pair.features.descriptors[rows], self.config.limits)
        return out

    def seen_again(self) -> np.ndarray:
        return np.asarray(self.manager.names[self.manager.observations >= SEEN_AGAIN])

    def expected(self, belief: Belief, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = ParticleSubsample.of(belief, self.config.subsample).expected(belief, self.model, ids)
        return seen.mean, seen.cov

    def kinds(self) -> np.ndarray:
        manager = self.manager
        out = np.full(self.ids.size, FeatureKind.FEATURE)
        rows, is_held = self.manager.find(self.ids)
        held, rows = np.flatnonzero(is_held), rows[is_held]
        out[held] = np.where(manager.confirmed[rows], FeatureKind.LANDMARK, FeatureKind.CANDIDATE)
        out[held[manager.observations[rows] == 1]] = FeatureKind.NEW
        return out

    def columns(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        """Number of observations, and whether each is a landmark or a candidate."""
        rows = np.searchsorted(self.manager.names, ids)
        confirmed = self.manager.confirmed[rows].astype(int)
        return {"sightings": self.manager.observations[rows], "landmark": confirmed}

    def counts(self, held: int) -> dict[str, float | int]:
        """All particles have the same landmarks, as their associations are common."""
        landmarks = float(self.manager.confirmed.sum())
        return {"sift_features": int(self.manager.next_name), "landmarks_mean_per_particle": landmarks}

    def confirmed_static(self) -> np.ndarray:
        return np.flatnonzero(np.isin(self.kinds(), (FeatureKind.LANDMARK, FeatureKind.CANDIDATE)))

    def arrays(self) -> dict[str, np.ndarray]:
        learnt = {} if self.noise is None else self.noise.arrays()
        return self.manager.arrays() | self.places.arrays() | learnt

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self.manager.restore(arrays)
        if not np.isin(self.manager.names, arrays[MAP_IDS]).all():
            raise InputError("a landmark that is managed is not in the map")
        self.places.restore(arrays, landmarks=len(self.manager))
        if self.noise is not None:
            self.noise.restore(arrays)

    def _accepted(
        self, expected: Expected, features: StereoFeatures, uncertain: bool, rng: np.random.Generator
    ) -> np.ndarray:
        """Mask (k,) of accepted matches: all, unless predictions are too uncertain for the gate to be selective."""
        all_of_them = np.ones(len(features), dtype=bool)
        vague = uncertain or (len(features) and np.median(expected.deviation) > self.config.vague_px)
        if not vague:
            return all_of_them
        if len(features) < self.config.min_agreeing:
            return ~all_of_them
        # Consensus on the heaviest particle's predictions, under an increment of any size.
        cov = expected.within + TINY * np.eye(3)
        matches = Matches.checked(self.rig, expected.by_heaviest, features.z, cov, features.cov)
        config = VoConfig(min_matches=self.config.min_agreeing)
        return estimate_motion(matches, rng, config=config).inliers
