"""From features that were found to observations of landmarks, and from the map to where features should be found.

A feature is in the map as a world point once its depth is known; before, as an `UnknownDepth` says: a ray with an
inverse depth, unless the system is given something else. Known points may be members of one landmark, a constellation.
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

MIN_DEPTHS = 4  #: Depths that must be known in view for new features to start at them.
MIN_SCALED = 3  #: Points that must be seen for the scale to be theirs: so many determine the camera's pose.
#: Times the standard deviation that the prior of depth has, which a young ray that moves in the image is given along
#: its line on top: the same prior comes again in every frame, so that in a frame it counts a tenth.
WIDENED = 3.0
#: Squared displacement in the image over the noise of both places, up to which a ray is seen where it was started.
STILL_CHI2 = 4.0
#: Times the greatest standard deviation at which something is looked for: so far off a measurement is taken as linear.
LINEAR = 3.0


class UnknownDepth(ABC):
    """How features are kept and used as long as their depth is not known well enough for a world point."""

    landmark: Landmark  #: their parametrisation in the map; of one component.
    model: CameraModel  #: how a camera measures them.

    def tune(self, camera: Pinhole, about: np.ndarray) -> None:
        """As `FeatureSensor.tune`; to be overridden where there is a joint map."""
        raise InputError(f"{type(self).__name__} has no camera that calibrates itself")

    @abstractmethod
    def starting(self, depths: np.ndarray) -> CameraModel:
        """The model whose `initialise` starts features, where points (D,) of these depths [m] are in view."""

    @abstractmethod
    def observations(
        self, belief: Belief, z: np.ndarray, cov: np.ndarray, ids: np.ndarray, scaled: bool, held: bool
    ) -> list[Observations]:
        """What features (K,) of this parametrisation at z (K, 2) px, cov (K, 2, 2) px², say of the pose and of themselves.

        `scaled` is whether points are seen that hold the scale, which else the prior of depth does; `held` whether known ones
        are among them.
        """

    @abstractmethod
    def promotable(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        """Ids (P,) of what was observed and is known well enough now to be turned into world points."""

    @abstractmethod
    def depth_std_ratio(self, records: Records) -> np.ndarray:
        """Standard deviation of the depth as a fraction of it (N, K); infinite where the depth is not known at all."""

    @abstractmethod
    def extent(self, records: Records, sigmas: float, min_weight: float = 0.0) -> np.ndarray:
        """Nearest and farthest homogeneous point (N, K, 2, 4), so many standard deviations from the mean.

        Their last entry is not below `min_weight`; 0 is at infinity.
        """

    def as_points(self, records: Records) -> Records:
        """The features as Gaussian world points (N, K, 3), to first order, for reports."""
        points, slope = self.landmark.point(records.mean, records.const)
        return Records(points, gaussian.symmetrise(slope @ records.cov @ np.swapaxes(slope, -1, -2)))


class InverseDepthRays(UnknownDepth):
    """Rays with an inverse depth from where a feature was seen first, E06 §5."""

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
        """At the median inverse depth of the points in view, where there are enough of them."""
        return CameraRay(self.camera, self.prior(depths), about=self.model.about)

    def prior(self, depths: np.ndarray) -> tuple[float, float]:
        """Mean and standard deviation of inverse depths, 1/m, where points are at these depths (K,).

        Rays that all start too near or too far agree with one another on a wrong scale: the prior takes them as
        independent, the scene's depth is common to them.
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
        """Epipolar constraint, 2-D marginal, or an update of depth alone, as `InverseDepthConfig.pose_update` says.

        Which of them is decided for a feature, not for a particle: the density of what was measured is one in all
        particles, continuous in the pose. Decided by each particle's own parallax, it rewards motion that did not happen.
        """
        # Depth is measured where it moves the image in the particle of highest weight, E06 §5.1, last paragraph.
        state, mode = belief.state[belief.mode], belief.mode
        _, jac, records = belief.map.innovations(self.model, z, ids, state, mode)
        assert jac.landmark is not None
        # What is still seen where it was started has no line: that its image stays says that the camera does. But the prior
        # of depth then comes anew in every frame, which only known points outweigh.
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
        """Whose inverse depth is known to `promote_std_ratio` in `promote_weight` of the particles' weight."""
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
    """Takes features with names (`FeatureFrame`), and says where the map has features.

    A feature's name is its landmark's id. Members of a constellation, the known points of `group`, have none of their own;
    its id is the first one's name. The points of a `fixed` map say where the camera is, and are not changed by what is seen.
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
        """From now on the map is a joint one, which holds the known points one by one.

        What is expected with a greater standard deviation than `reach_px` cannot be looked for. Without `noise`, what is
        measured is as exact as it says.
        """
        self.unknown_depth, self._reach_px, self.noise, self.group = unknown_depth, reach_px, noise, None

    def tune(self, camera: Pinhole, about: np.ndarray) -> None:
        """The camera of a joint map that it is estimated in, at the substate `about` (m,)."""
        self.camera, self.point = camera, CameraPoint(camera, about=about)
        self.unknown_depth.tune(camera, about)

    @property
    def noise_factor(self) -> float:
        """Of the variance that what is measured says, for all features."""
        return 1.0 if self.noise is None else self.noise.mean

    def noisy(self, names: np.ndarray, cov: np.ndarray) -> np.ndarray:
        """Covariances (K, 2, 2) of the noise of features (K,), as stated, times the factor of each."""
        return cov if self.noise is None else self.noise.factor(names)[:, None, None] * cov

    def observe(self, frame: FeatureFrame, belief: Belief) -> Sequence[Observations]:
        """Groups of observations for known points, points, and features of unknown depth."""
        groups, inside = list[Observations](), self.camera.inside(frame.z)
        cov_z = self.noisy(frame.landmarks, frame.cov_z)

        # All members of the constellation that are seen are one measurement of it.
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
        """As `start`; a joint map that is full puts features away, and brings those back whose names are seen."""
        started = self.start(frame, belief, observed)
        self.make_room(belief, frame.landmarks)
        return started

    def make_room(self, belief: Belief, seen: np.ndarray) -> np.ndarray:
        """Names (K,) that a full joint map lets go: what is out of view, the farthest from where the camera looks first."""
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
        """Whether a joint map is so unsure of its frame's place that what was seen at first cannot be looked for."""
        points = joint.held.by_kind()[0] if joint.ids.size else None
        if joint.old.frame is None or points is None or points.landmark.anchored:
            return False
        depth = float(np.median(np.linalg.norm(joint.mean[0, points.columns], axis=1)))
        turn, shift = (np.linalg.eigvalsh(joint.old.frame.cov[part, part])[-1] for part in (slice(3), slice(3, 6)))
        return bool(self.camera.fx * np.sqrt(turn + shift / depth**2) > self._reach_px)

    def expected(self, joint: JointMap, names: np.ndarray) -> np.ndarray:
        """Which old landmarks (K,) can be looked for, as far as the map is sure of their places."""
        if not self.is_unsure(joint):
            return np.ones(names.size, dtype=bool)
        return np.isin(names, joint.old.surely_near(self._reach_px / self.camera.fx))

    def amiss(self, belief: Belief, frame: FeatureFrame) -> np.ndarray:
        """Which of a frame's features (K,) are of old sub-maps, and seen too far from where an unsure map has them."""
        joint, amiss = belief.map, np.zeros(frame.landmarks.size, dtype=bool)
        assert isinstance(joint, JointMap)
        if not self.is_unsure(joint):
            return amiss
        away = np.flatnonzero(np.isin(frame.landmarks, joint.old.ids) & ~joint.holds(frame.landmarks))
        points = joint.old.guess(frame.landmarks[away])
        seen = self.camera.project(SE3.inverse_transform(self.pose(belief), points))
        amiss[away] = ~(np.linalg.norm(seen - frame.z[away], axis=1) <= LINEAR * self._reach_px)
        return amiss

    def start(self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]) -> Sequence[NewLandmarks]:
        """Turns features whose depth is known by now into points; starts one for every new name."""
        if self.noise is not None:
            # Of points alone: a young ray is off by more than its covariance says, which is to first order.
            for group in observed:
                if group.model is self.point:
                    self.noise.learn_from(group, partial(belief.project, self.point))
        belief.map.promote(self.unknown_depth.promotable(belief, observed), Point(3))
        is_new = (self.members(frame.landmarks) < 0) & ~belief.map.holds(frame.landmarks)
        if isinstance(belief.map, JointMap):
            is_old = is_new & np.isin(frame.landmarks, belief.map.old.ids)
            belief.map.bring_back(frame.landmarks[is_old & ~self.amiss(belief, frame)])
            is_new &= ~is_old
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
        """Where features (K,) should be seen under all particles: which of them, means (k, 2), covariances (k, 2, 2)."""
        parts = []
        for model, chosen, ids in self.by_model(belief, names):
            mean, cov = belief.project(model, ids)
            parts.append((chosen, mean.reshape(-1, 2), _diagonal_blocks(cov, chosen.size)))
        which, means, covs = map(np.concatenate, zip(*parts, strict=True))
        return which, means, covs

    def innovations(
        self, belief: Belief, names: np.ndarray, px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of features (K,) found at px (K, 2), in the heaviest particle: which, ν (k, 2), H (k, 2, d), J P Jᵀ (k, 2, 2)."""
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
        """Where features (K,) are in the heaviest particle's world: which of them, homogeneous points (k, 4)."""
        which, places = self.positions_in(belief, names, slice(belief.mode, belief.mode + 1))
        return which, places[0]

    def positions_in(self, belief: Belief, names: np.ndarray, particles: slice) -> tuple[np.ndarray, np.ndarray]:
        """Likewise in the worlds of some particles: which features, homogeneous points (n, k, 4)."""
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
        """Of those features (K,) whose depth is not known: which, and where they may be (k, 2, 4): `UnknownDepth.extent`."""
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
        """Homogeneous points (n, k, 4) of some particles' frames, where states are, in their worlds."""
        identity = SE3.identity((len(position),))
        world = belief.map.world(identity, particles)
        if world is identity:
            return position
        x, w = position[..., :3], position[..., 3:]
        origin = SE3.translation(world)[:, None]
        return np.concatenate([SE3.transform(world[:, None], x) + (w - 1.0) * origin, w], axis=-1)

    def members(self, names: np.ndarray) -> np.ndarray:
        """Number of features (K,) among the points of the constellation, −1 of others."""
        if self.group is None or not self.group.names.size:
            return np.full(names.size, -1)
        same = names[:, None] == self.group.names
        return np.where(same.any(axis=1), same.argmax(axis=1), -1)

    def _ids(self, belief: Belief, names: np.ndarray, members: np.ndarray) -> np.ndarray:
        """Landmarks (K,) of features (K,), −1 where the map has none of their own; `members` are theirs."""
        return np.where((members < 0) & belief.map.holds(names), names, -1)

    def by_model(
        self, belief: Belief, names: np.ndarray
    ) -> list[tuple[CameraModel | MembersView, np.ndarray, np.ndarray]]:
        """Features (K,) by how they are measured: the model, which of them, and the landmarks' ids."""
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
        """Of the points that were just seen, and of the known points in view, in the heaviest particle."""
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
