"""Turns matched features into observations of landmarks, and predicts features from the map.

A feature is stored as a world point once its depth is known; before, as defined by an `UnknownDepth`, by default a ray with
an inverse depth. Known points may be members of one landmark, a constellation.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.likelihoods import squared_mahalanobis
from rbpf.core.models import Belief, Landmark, NewLandmarks, Observations, Part, Records, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.maps.rows import BOTH, MAP, STATE
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraModel, CameraPoint, CameraRay, EpipolarRay, MembersView
from rbpf.sensors.feature_log import FeatureFrame, KnownPoints
from rbpf.systems.learnt_noise import LearntNoise
from rbpf.systems.mono.config import InverseDepthConfig
from rbpf.systems.mono.feature_table import directions

MIN_DEPTHS = 4  #: Known depths in view required to initialise new features at their median.
MIN_SCALED = 3  #: Points that must be observed to fix the scale: the number that determines the camera's pose.
#: Factor on the depth prior's standard deviation that is added along the epipolar line for a young ray that moves in the
#: image: the same prior recurs in every frame, so in one frame it counts a tenth.
WIDENED = 3.0
#: Squared image displacement, over the noise of both positions, up to which a ray counts as not having moved.
STILL_CHI2 = 4.0
#: Range in which measurements are treated as linear, relative to the greatest standard deviation searched.
LINEAR = 3.0


class UnknownDepth(ABC):
    """Storage and use of features whose depth is not known well enough for a world point."""

    landmark: Landmark  #: their parametrisation in the map; of one component.
    model: CameraModel  #: their observation model.

    def tune(self, camera: Pinhole, about: np.ndarray) -> None:
        """As `FeatureSensor.tune`; must be overridden for a joint map."""
        raise InputError(f"{type(self).__name__} does not support self-calibration")

    @abstractmethod
    def starting(self, depths: np.ndarray) -> CameraModel:
        """The model whose `initialise` is used for new features, given the depths (D,) [m] of points in view."""

    @abstractmethod
    def observations(
        self, belief: Belief, z: np.ndarray, cov: np.ndarray, ids: np.ndarray, scaled: bool, held: bool
    ) -> list[Observations]:
        """Observations of features (K,) of this parametrisation at z (K, 2) px, with cov (K, 2, 2) px².

        `scaled` tells whether observed points fix the scale, otherwise the depth prior does; `held` whether known points are
        among them.
        """

    @abstractmethod
    def promotable(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        """Ids (P,) of observed features that can now be promoted to world points."""

    @abstractmethod
    def depth_std_ratio(self, records: Records) -> np.ndarray:
        """Standard deviation of the depth as a fraction of it (N, K); infinite for unknown depth."""

    @abstractmethod
    def extent(self, records: Records, sigmas: float, min_weight: float = 0.0) -> np.ndarray:
        """Nearest and farthest homogeneous point (N, K, 2, 4), at `sigmas` standard deviations from the mean.

        Their last entry is not below `min_weight`; 0 is at infinity.
        """

    def as_points(self, records: Records) -> Records:
        """The features as Gaussian world points (N, K, 3), to first order, for reports."""
        points, slope = self.landmark.point(records.mean, records.const)
        return Records(points, gaussian.symmetrise(slope @ records.cov @ np.swapaxes(slope, -1, -2)))


class InverseDepthRays(UnknownDepth):
    """Rays with an inverse depth, anchored at the first observation, E06 §5."""

    landmark: InverseDepth
    model: CameraRay

    def __init__(self, camera: Pinhole, config: InverseDepthConfig) -> None:
        rho = (config.mean_per_m, config.std_per_m)
        self.camera, self.config = camera, config
        self.landmark = InverseDepth(config.promote_std_ratio)
        self.model = CameraRay(camera, rho)
        self.epipolar = EpipolarRay(camera, rho)

    def tune(self, camera: Pinhole, about: np.ndarray) -> None:
        """As `FeatureSensor.tune`."""
        self.camera, self.model = camera, CameraRay(camera, self.model.rho, about=about)

    def starting(self, depths: np.ndarray) -> CameraModel:
        """At the median inverse depth of the points in view, if there are enough."""
        return CameraRay(self.camera, self.prior(depths), about=self.model.about)

    def prior(self, depths: np.ndarray) -> tuple[float, float]:
        """Mean and standard deviation of inverse depths, 1/m, given points at these depths (K,).

        Rays that all start too near or too far consistently support a wrong scale: the prior treats them as independent,
        whereas the scene's depth is common to them.
        """
        mean, std = self.config.mean_per_m, self.config.std_per_m
        if not self.config.from_scene_depth or depths.size < MIN_DEPTHS:
            return mean, std
        rho = 1.0 / depths
        middle = float(np.median(rho))
        return middle, max(std / mean * middle, float(rho.std()))

    def observations(
        self, belief: Belief, z: np.ndarray, cov: np.ndarray, ids: np.ndarray, scaled: bool, held: bool
    ) -> list[Observations]:
        """Epipolar constraint, 2-D marginal, or an update of depth alone, by `InverseDepthConfig.pose_update`.

        The choice is made per feature, not per particle: the likelihood has the same form in all particles and is continuous
        in the pose. A choice by each particle's own parallax would reward motion that did not happen.
        """
        # Depth counts as measured if it moves the image in the particle of highest weight, E06 §5.1, last paragraph.
        state, mode = belief.state[belief.mode], belief.mode
        _, jac, records = belief.map.innovations(self.model, z, ids, state, mode)
        assert jac.landmark is not None
        # A ray that has not moved in the image has no epipolar line: that its image stays shows that the camera does. But
        # this uses the depth prior anew in every frame, which is harmless only with known points.
        displacement = z - self.camera.project(np.insert(records.mean[0, :, :2], 2, 1.0, axis=1))
        still = held & (squared_mahalanobis(displacement, 2.0 * cov) < STILL_CHI2)
        by_depth = self.config.std_per_m * jac.landmark[..., 2]
        squared = np.square(by_depth).sum(axis=-1)
        measured = squared >= self.config.depth_parallax_px**2
        has_line = ~still & (squared >= self.config.epipolar_parallax_px**2)

        def group(
            model: CameraRay, rows: np.ndarray, updates: frozenset[Part], noise: np.ndarray = cov
        ) -> list[Observations]:
            if not rows.any():
                return []
            return [Observations(z[rows], noise[rows], model, ids=ids[rows], updates=updates)]

        depth, young = group(self.model, measured, MAP), ~has_line
        if self.config.pose_update == "off":
            return depth
        if self.config.pose_update == "marginal":
            depth = group(self.model, measured, BOTH)
            if not scaled:
                return depth + group(self.model, ~measured, STATE)
            young, has_line = young & ~measured, has_line & ~measured
        along = np.where(still, 0.0, WIDENED)[:, None] * by_depth
        widened = cov + along[:, :, None] * along[:, None, :]
        return depth + group(self.model, young, STATE, widened) + group(self.epipolar, has_line, STATE)

    def promotable(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        """Those with an inverse depth known to `promote_std_ratio` in `promote_weight` of the particles' weight."""
        updated = [group.ids for group in observed if group.model is self.model and group.updates != STATE]
        if not updated:
            return np.zeros(0, dtype=np.int64)
        ids = np.concatenate([each for each in updated if each is not None])
        ready = belief.weights @ self.landmark.ready(belief.read(ids))
        return np.asarray(ids[ready >= self.config.promote_weight])

    def depth_std_ratio(self, records: Records) -> np.ndarray:
        """σ_ρ / ρ."""
        rho, std = records.mean[..., 2], np.sqrt(records.cov[..., 2, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(rho > 0.0, std / rho, np.inf)

    def extent(self, records: Records, sigmas: float, min_weight: float = 0.0) -> np.ndarray:
        """At ρ + σ and ρ − σ."""
        assert records.const is not None
        mean = records.mean[..., None, :].repeat(2, axis=-2)
        spread = sigmas * np.sqrt(records.cov[..., 2, 2])
        mean[..., 2] = np.maximum(mean[..., 2] + np.stack([spread, -spread], axis=-1), min_weight)
        return self.landmark.homogeneous(mean, records.const[..., None, :])


@final
class FeatureSensor(Sensor):
    """Sensor of named features (`FeatureFrame`), which also predicts features from the map.

    A feature's name is its landmark's id. Members of a constellation, the known points of `group`, are not landmarks
    themselves; its id is the first one's name. Points of a `fixed` map localise the camera, and are not updated.
    """

    def __init__(
        self,
        camera: Pinhole,
        unknown_depth: UnknownDepth,
        max_new_per_frame: int,
        group: KnownPoints | None = None,
        fixed: bool = False,
    ) -> None:
        self.camera = camera
        self.unknown_depth = unknown_depth
        self.max_new_per_frame = 0 if fixed else max_new_per_frame
        self.fixed = fixed
        self._reach_px = np.inf
        self.noise: LearntNoise | None = None
        self.point = CameraPoint(camera)
        self.group = group

    def become_joint(self, unknown_depth: UnknownDepth, reach_px: float, noise: LearntNoise | None = None) -> None:
        """Switches to a joint map, in which known points are separate landmarks.

        Predictions with a standard deviation above `reach_px` cannot be searched. Without `noise` the stated noise is used.
        """
        self.unknown_depth, self._reach_px, self.noise, self.group = unknown_depth, reach_px, noise, None

    def tune(self, camera: Pinhole, about: np.ndarray) -> None:
        """Sets the camera of a joint map with self-calibration, at the substate `about` (m,)."""
        self.camera, self.point = camera, CameraPoint(camera, about=about)
        self.unknown_depth.tune(camera, about)

    @property
    def noise_factor(self) -> float:
        """Common factor of the stated measurement variance."""
        return 1.0 if self.noise is None else self.noise.mean

    def noisy(self, names: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """Covariances (K, 2, 2) of the noise of features (K,), as stated, times the factor of each."""
        return cov if self.noise is None else self.noise.factor(names)[:, None, None] * cov

    def observe(self, frame: FeatureFrame, belief: Belief) -> Sequence[Observations]:
        """Groups of observations for known points, points, and features of unknown depth."""
        groups, inside = list[Observations](), self.camera.inside(frame.z)
        cov_z = self.noisy(frame.landmarks, frame.cov_z)

        # All observed members of the constellation form one measurement of it.
        members = self.members(frame.landmarks)
        ids = self._ids(belief, frame.landmarks, members)
        rows = np.flatnonzero((members >= 0) & inside)
        held = rows.size > 0
        if held:
            landmark, view = self._view(members[rows])
            cov, each = np.zeros((1, view.dim, view.dim)), np.arange(rows.size)
            cov.reshape(rows.size, 2, rows.size, 2)[each, :, each] = cov_z[rows]
            groups.append(Observations(frame.z[rows].reshape(1, -1), cov, view, ids=landmark))

        rows = np.flatnonzero((ids >= 0) & inside)
        unknown = belief.map.are(ids[rows], self.unknown_depth.landmark)
        if (~unknown).any():
            k = rows[~unknown]
            updates = STATE if self.fixed else BOTH
            groups.append(Observations(frame.z[k], cov_z[k], self.point, ids=ids[k], updates=updates))
        if unknown.any():
            k = rows[unknown]
            scaled = sum(group.z.size for group in groups) >= 2 * MIN_SCALED
            groups += self.unknown_depth.observations(belief, frame.z[k], cov_z[k], ids[k], scaled, held)
        return groups

    def new_landmarks(
        self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """As `start`; a full joint map puts features away."""
        started = self.start(frame, belief, observed)
        self.make_room(belief, frame.landmarks)
        return started

    def make_room(self, belief: Belief, seen: np.ndarray) -> np.ndarray:
        """Names (K,) that a full joint map removes: features out of view, those farthest from the viewing direction first."""
        joint = belief.map
        if not isinstance(joint, JointMap) or not joint.is_full:
            return np.zeros(0, dtype=np.int64)
        others = np.setdiff1d(np.setdiff1d(joint.ids, joint.leaving), seen)
        which, position = self.positions(belief, others)
        direction = directions(position, self.pose(belief))
        others, direction = (each[~self.camera.visible(direction)] for each in (others[which], direction))
        order = np.argsort(direction[:, 2] / np.linalg.norm(direction, axis=1), kind="stable")
        return joint.make_room(others[order])

    def is_unsure(self, joint: JointMap) -> bool:
        """Whether a joint map's frame is so uncertain that the first landmarks cannot be searched."""
        points = joint.held.by_kind()[0] if joint.ids.size else None
        if joint.old.frame is None or points is None or points.landmark.anchored:
            return False
        depth = float(np.median(np.linalg.norm(joint.mean[0, points.columns], axis=1)))
        turn, shift = (np.linalg.eigvalsh(joint.old.frame.cov[part, part])[-1] for part in (slice(3), slice(3, 6)))
        return bool(self.camera.fx * np.sqrt(turn + shift / depth**2) > self._reach_px)

    def expected(self, joint: JointMap, names: np.ndarray) -> np.ndarray:
        """Mask of the old landmarks (K,) whose predictions are precise enough to be searched."""
        if not self.is_unsure(joint):
            return np.ones(names.size, dtype=bool)
        return np.isin(names, joint.old.surely_near(self._reach_px / self.camera.fx))

    def amiss(self, belief: Belief, frame: FeatureFrame) -> np.ndarray:
        """Mask of a frame's features (K,) of old sub-maps that are observed too far from an uncertain map's prediction."""
        joint, amiss = belief.map, np.zeros(frame.landmarks.size, dtype=bool)
        assert isinstance(joint, JointMap)
        if not self.is_unsure(joint):
            return amiss
        away = np.flatnonzero(np.isin(frame.landmarks, joint.old.ids) & ~joint.holds(frame.landmarks))
        points = joint.old.guess(frame.landmarks[away])
        seen = self.camera.project(SE3.inverse_transform(self.pose(belief), points))
        amiss[away] = ~(np.linalg.norm(seen - frame.z[away], axis=1) <= LINEAR * self._reach_px)
        return amiss

    def bring_back(self, joint: JointMap, frame: FeatureFrame, belief: Belief) -> bool:
        """Adds features of old sub-maps that a frame observes, at the end of the window; whether any can be added."""
        known = joint.holds(frame.landmarks) | np.isin(frame.landmarks, joint.old.ids)
        return joint.bring_back(frame.landmarks[known & self.camera.inside(frame.z) & ~self.amiss(belief, frame)])

    def start(self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]) -> Sequence[NewLandmarks]:
        """Promotes features of known depth to points; initialises one for every new name."""
        if self.noise is not None:
            # Of points alone: a young ray's error exceeds its covariance, which is of first order.
            for group in observed:
                if group.model is self.point:
                    self.noise.learn_from(group, partial(belief.project, self.point))
        belief.map.promote(self.unknown_depth.promotable(belief, observed), Point(3))
        is_new = (self.members(frame.landmarks) < 0) & ~belief.map.holds(frame.landmarks)
        if isinstance(belief.map, JointMap):
            is_new &= ~np.isin(frame.landmarks, belief.map.old.ids)
        if not is_new.any():
            return []
        new = np.flatnonzero(is_new & self.camera.inside(frame.z))
        new = new[np.isfinite(self.camera.unproject(frame.z[new])).all(axis=-1)][: self.max_new_per_frame]
        if not new.size:
            return []
        model = self.unknown_depth.starting(self._depths(belief, observed))
        z, cov, ids = frame.z[new], self.noise_factor * frame.cov_z[new], frame.landmarks[new]
        return [NewLandmarks(z, cov, model, self.unknown_depth.landmark, ids=ids)]

    def project(self, belief: Belief, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Predictions of features (K,) over all particles: rows of those in the map, means (k, 2), covariances (k, 2, 2)."""
        parts = []
        for model, chosen, ids in self.by_model(belief, names):
            mean, cov = belief.project(model, ids)
            parts.append((chosen, mean.reshape(-1, 2), _diagonal_blocks(cov, chosen.size)))
        which, means, covs = map(np.concatenate, zip(*parts, strict=True))
        return which, means, covs

    def innovations(
        self, belief: Belief, names: np.ndarray, px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """For features (K,) matched at px (K, 2), in the heaviest particle: rows, ν (k, 2), H (k, 2, d), J P Jᵀ (k, 2, 2)."""
        parts = []
        for model, chosen, ids in self.by_model(belief, names):
            z = px[chosen].reshape(1, -1) if isinstance(model, MembersView) else px[chosen]
            nu, jac, cov = belief.innovations(model, z, ids)
            of_each = nu.reshape(-1, 2), jac.reshape(chosen.size, 2, -1), _diagonal_blocks(cov, chosen.size)
            parts.append((chosen, *of_each))
        which, nus, jacs, covs = map(np.concatenate, zip(*parts, strict=True))
        return which, nus, jacs, covs

    def pose(self, belief: Belief) -> np.ndarray:
        """(7,) world_from_camera of the heaviest particle, in its world."""
        mode = slice(belief.mode, belief.mode + 1)
        return belief.map.world(belief.state[mode, :7], mode)[0]

    def positions(self, belief: Belief, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions of features (K,) in the heaviest particle's world: rows of those in the map, homogeneous points (k, 4)."""
        which, places = self.positions_in(belief, names, slice(belief.mode, belief.mode + 1))
        return which, places[0]

    def positions_in(self, belief: Belief, names: np.ndarray, particles: slice) -> tuple[np.ndarray, np.ndarray]:
        """Likewise in the worlds of some particles: rows, homogeneous points (n, k, 4)."""
        n = belief.log_weights[particles].size
        which, out = [np.zeros(0, dtype=np.int64)], [np.zeros((n, 0, 4))]
        for model, chosen, ids in self.by_model(belief, names):
            records = belief.read(ids, particles)
            which.append(chosen)
            if isinstance(model, MembersView):
                points = model.in_world(records.mean, records.const)[:, 0]
                out.append(np.pad(points, ((0, 0), (0, 0), (0, 1)), constant_values=1.0))
            else:
                x, w = model.world_point(records.mean, records.const)
                out.append(np.concatenate([x, w], axis=-1))
        return np.concatenate(which), self._in_world(belief, np.concatenate(out, axis=1), particles)

    def depth_known(self, belief: Belief, names: np.ndarray, std_ratio: float) -> np.ndarray:
        """Whether the heaviest particle knows the depth of features (K,) to this fraction of it, (K,) bool."""
        out = np.zeros(names.size, dtype=bool)
        for model, chosen, ids in self.by_model(belief, names):
            out[chosen] = True
            if model is self.unknown_depth.model:
                out[chosen] = self.unknown_depth.depth_std_ratio(belief.read_mode(ids))[0] <= std_ratio
        return out

    def extents(
        self, belief: Belief, names: np.ndarray, sigmas: float, min_weight: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of features (K,) of unknown depth: rows, and their extents (k, 2, 4), see `UnknownDepth.extent`."""
        ids = self._ids(belief, names, self.members(names))
        held = np.flatnonzero(ids >= 0)
        unknown = held[belief.map.are(ids[held], self.unknown_depth.landmark)]
        if not unknown.size:
            return unknown, np.zeros((0, 2, 4))
        mode = slice(belief.mode, belief.mode + 1)
        ends = self.unknown_depth.extent(belief.read(ids[unknown], mode), sigmas, min_weight)
        return unknown, self._in_world(belief, ends.reshape(1, -1, 4), mode).reshape(-1, 2, 4)

    def remove(self, belief: Belief, names: np.ndarray) -> None:
        """Drops features from all particles."""
        if names.size:
            ids = self._ids(belief, names, self.members(names))
            belief.map.remove(ids[ids >= 0])
            if self.noise is not None:
                self.noise.remove(names)

    def _in_world(self, belief: Belief, position: np.ndarray, particles: slice) -> np.ndarray:
        """Transforms homogeneous points (n, k, 4) from some particles' state frames to their worlds."""
        identity = SE3.identity((len(position),))
        world = belief.map.world(identity, particles)
        if world is identity:
            return position
        x, w = position[..., :3], position[..., 3:]
        origin = SE3.translation(world)[:, None]
        return np.concatenate([SE3.transform(world[:, None], x) + (w - 1.0) * origin, w], axis=-1)

    def members(self, names: np.ndarray) -> np.ndarray:
        """Indices of features (K,) in the constellation, −1 for others."""
        if self.group is None or not self.group.names.size:
            return np.full(names.size, -1)
        same = names[:, None] == self.group.names
        return np.where(same.any(axis=1), same.argmax(axis=1), -1)

    def _ids(self, belief: Belief, names: np.ndarray, members: np.ndarray) -> np.ndarray:
        """Landmark ids (K,) of features (K,), −1 for those not in the map; `members` are their constellation indices."""
        return np.where((members < 0) & belief.map.holds(names), names, -1)

    def by_model(
        self, belief: Belief, names: np.ndarray
    ) -> list[tuple[CameraModel | MembersView, np.ndarray, np.ndarray]]:
        """Features (K,) grouped by observation model: the model, their rows, and the landmarks' ids."""
        member = self.members(names)
        ids = self._ids(belief, names, member)
        own = np.flatnonzero(ids >= 0)
        unknown = belief.map.are(ids[own], self.unknown_depth.landmark)
        out: list[tuple[CameraModel | MembersView, np.ndarray, np.ndarray]] = []
        for model, chosen in ((self.point, own[~unknown]), (self.unknown_depth.model, own[unknown])):
            if chosen.size:
                out.append((model, chosen, ids[chosen]))
        of_group = np.flatnonzero(member >= 0)
        if of_group.size:
            landmark, view = self._view(member[of_group])
            out.append((view, of_group, landmark))
        return out

    def _view(self, members: np.ndarray) -> tuple[np.ndarray, MembersView]:
        """The constellation's id (1,), and the camera's view of some of its members."""
        assert self.group is not None
        return self.group.names[:1], MembersView(self.camera, members)

    def _depths(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        """Depths of the points just observed, and of the known points in view, in the heaviest particle."""
        pose = belief.state[belief.mode][:7]
        seen = [np.zeros((0, 3))]
        for group in observed:
            if group.ids is not None and isinstance(group.model, CameraPoint):
                seen.append(SE3.inverse_transform(pose, belief.read_mode(group.ids).mean[0]))
        if self.group is not None:
            landmark = int(self.group.names[0])
            known = belief.map.landmark_of(landmark)
            assert isinstance(known, Constellation)
            points = known.in_world(belief.read_mode([landmark]))[0]
            seen.append(SE3.inverse_transform(pose, points))
        point = np.concatenate(seen)
        return np.asarray(point[self.camera.visible(point), 2])


def _diagonal_blocks(cov: np.ndarray, count: int) -> np.ndarray:
    """Covariances (count, 2, 2) of single points from (count, 2, 2) itself or from (1, 2 count, 2 count)."""
    if cov.shape[0] == count and cov.shape[1] == 2:
        return cov
    blocks = cov[0].reshape(count, 2, count, 2)
    return np.array([blocks[k, :, k] for k in range(count)])
