"""Points and rays from features that carry names: the measurement side of E06 without its images."""

from collections.abc import Sequence
from typing import final

import numpy as np

from rbpf.core.belief import Belief
from rbpf.core.models import NewLandmarks, Observations, Part, Sensor
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.point import Point
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.constellation import ConstellationView, MembersView
from rbpf.sensors.camera.points import CameraModel, CameraPoint, CameraRay, EpipolarRay
from rbpf.sensors.catalogue_index import NameIndex
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.config import InverseDepthConfig
from rbpf.systems.mono.known_start import KnownStart

CONSTELLATION = -1
"""Name of the known points' frame in the catalogue; features have names from 0 on."""

ENOUGH = 4
"""Points that must be seen for new rays to start at their depth."""

HOLD = 3
"""Points that must be seen for the scale to be theirs: so many determine the camera's pose."""

GroupView = ConstellationView | MembersView
"""Measurements of several known points at once."""

_STATE, _MAP = frozenset({Part.STATE}), frozenset({Part.LANDMARK})
_BOTH = _STATE | _MAP


@final
class FeatureSensor(Sensor):
    """Landmarks start as rays, constrain the pose as `InverseDepthConfig` says, and become points when their depth is known.

    Args:
        camera: of the images.
        rays: settings of landmarks without depth.
        max_new_per_frame: landmarks started in one frame at most.
        start: known points that are one landmark, a `Constellation`.
        fixed: the map is known: its points tell where the camera is, and are not changed by what is seen of them.
    """

    def __init__(
        self,
        camera: Pinhole,
        rays: InverseDepthConfig,
        max_new_per_frame: int,
        start: KnownStart | None = None,
        fixed: bool = False,
    ) -> None:
        rho = (rays.mean_per_m, rays.std_per_m)
        self.camera = camera
        self.rays = rays
        self.max_new_per_frame = 0 if fixed else max_new_per_frame
        self.fixed = fixed
        self.point = CameraPoint(camera)
        self.ray = CameraRay(camera, rho)
        self.epipolar = EpipolarRay(camera, rho, rays.epipolar_parallax_px)
        self.inverse_depth = InverseDepth(rays.promote_std_ratio)
        self._names = NameIndex()
        self._start = start
        self._place = {} if start is None else {name: m for m, name in enumerate(start.points.names.tolist())}

    def observe(self, frame: FeatureFrame, belief: Belief) -> Sequence[Observations]:
        """Groups for points and for rays."""
        known = self._names.ids(belief.catalogue)
        ids = np.array([known.get(name, -1) for name in frame.landmarks.tolist()], dtype=np.int64)
        inside = self.camera.inside(frame.z)
        rows = np.flatnonzero((ids >= 0) & inside)
        groups = self._constellation_group(frame, inside, belief)
        is_ray = belief.map.are(ids[rows], self.inverse_depth)
        if (~is_ray).any():
            k = rows[~is_ray]
            updates = _STATE if self.fixed else _BOTH
            groups.append(Observations(frame.z[k], frame.cov_z[k], self.point, ids=ids[k], updates=updates))
        if is_ray.any():
            scaled = sum(group.z.size for group in groups) >= 2 * HOLD
            groups += self._ray_groups(frame, belief, rows[is_ray], ids[rows[is_ray]], scaled)
        return groups

    def new_landmarks(
        self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """Promotes rays that are ready; starts a ray for every new name."""
        self._promote(belief, observed)
        known = self._names.ids(belief.catalogue)
        names = frame.landmarks.tolist()
        new = [k for k, name in enumerate(names) if name not in known and name not in self._place]
        if new:
            z = frame.z[new]
            has_ray = self.camera.inside(z) & np.isfinite(self.camera.unproject(z)).all(axis=-1)
            new = [k for k, seen in zip(new, has_ray.tolist(), strict=True) if seen][: self.max_new_per_frame]
        if not new:
            return []
        names = frame.landmarks[new].tolist()
        ray = self.new_ray(belief, observed)
        return [NewLandmarks(frame.z[new], frame.cov_z[new], ray, self.inverse_depth, facts=names)]

    def new_ray(self, belief: Belief, observed: Sequence[Observations]) -> CameraRay:
        """What starts rays: at the inverse depths of the points that were just seen, where there are enough of them.

        Rays that all start too near or too far agree with one another on a wrong scale: the prior takes them as
        independent, the scene's depth is common to them.
        """
        depth = self._depths(belief, observed) if self.rays.from_scene_depth else np.zeros(0)
        if depth.size < ENOUGH:
            return self.ray
        rho = 1.0 / depth
        middle = float(np.median(rho))
        fraction = self.rays.std_per_m / self.rays.mean_per_m
        return CameraRay(self.camera, (middle, max(fraction * middle, float(rho.std()))))

    def _depths(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        """Of the points that were just seen, and of the known points in view, in the heaviest particle."""
        pose = belief.state[belief.mode][:7]
        seen = [np.zeros((0, 3))]
        for group in observed:
            if group.ids is not None and isinstance(group.model, CameraPoint):
                seen.append(SE3.inverse_transform(pose, belief.read_mode(group.ids).mean[0]))
        if self._start is not None:
            landmark = self._names.ids(belief.catalogue)[CONSTELLATION]
            points = belief.map.landmark_of(landmark).in_world(belief.read_mode([landmark]))[0]
            seen.append(SE3.inverse_transform(pose, points))
        point = np.concatenate(seen)
        return np.asarray(point[self.camera.visible(point), 2])

    def project(
        self, belief: Belief, names: np.ndarray, members: np.ndarray
    ) -> list[tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]]:
        """Where features (K,) should be seen: which of them, their means (k, 2) and covariances (k, 2, 2), by kind."""
        out = []
        for model, chosen, ids in self._by_kind(belief, names, members):
            mean, cov = belief.project(model, ids)
            if isinstance(model, GroupView):
                mean = mean.reshape(-1, 2)
            cov = _diagonal_blocks(cov, chosen.size)
            out.append((chosen, (mean, cov)))
        return out

    def innovations(
        self, belief: Belief, names: np.ndarray, members: np.ndarray, px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of features (K,) found at px (K, 2), in the heaviest particle at its predicted pose.

        Returns:
            Which features, ν (k, 2), H (k, 2, d) and J P Jᵀ (k, 2, 2).
        """
        which, nus, jacs, covs = [], [], [], []
        for model, chosen, ids in self._by_kind(belief, names, members):
            z = px[chosen].reshape(1, -1) if isinstance(model, GroupView) else px[chosen]
            nu, jac, cov = belief.innovations(model, z, ids)
            which.append(chosen)
            nus.append(nu.reshape(-1, 2))
            jacs.append(jac.reshape(chosen.size, 2, -1))
            covs.append(_diagonal_blocks(cov, chosen.size))
        return np.concatenate(which), np.concatenate(nus), np.concatenate(jacs), np.concatenate(covs)

    def places(self, belief: Belief, names: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where features (K,) are in the world of the heaviest particle: which of them, homogeneous points (k, 4)."""
        which, out = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 4))]
        for model, chosen, ids in self._by_kind(belief, names, members):
            records = belief.read_mode(ids)
            const = None if records.const is None else records.const[0]
            which.append(chosen)
            if isinstance(model, GroupView):
                out.append(
                    np.pad(model.in_world(records.mean[0], const)[0], ((0, 0), (0, 1)), constant_values=1.0)
                )
            else:
                x, w = model.world_point(records.mean[0], const)
                out.append(np.concatenate([x, w], axis=-1))
        return np.concatenate(which), np.concatenate(out)

    def deep(self, belief: Belief, names: np.ndarray, members: np.ndarray, fraction: float) -> np.ndarray:
        """Whether the heaviest particle knows the depth of features (K,) to this fraction of it, (K,) bool."""
        out = np.zeros(names.size, dtype=bool)
        for model, chosen, ids in self._by_kind(belief, names, members):
            out[chosen] = True
            if model is self.ray:
                records = belief.read_mode(ids)
                rho, variance = records.mean[0, :, 2], records.cov[0, :, 2, 2]
                out[chosen] = (rho > 0.0) & (np.sqrt(variance) <= fraction * rho)
        return out

    def first_places(self, world_from_camera: np.ndarray, px: np.ndarray, ray: CameraRay) -> np.ndarray:
        """Homogeneous points (k, 4) of rays that start at px (k, 2) from a camera (7,)."""
        records = ray.initialise(world_from_camera[None], px, np.zeros((px.shape[0], 2, 2)))
        x, w = self.ray.world_point(records.mean[0], records.const[0] if records.const is not None else None)
        return np.concatenate([x, w], axis=-1)

    def forget(self, belief: Belief, names: np.ndarray) -> None:
        """Drops features from all particles."""
        known = self._names.ids(belief.catalogue)
        belief.map.remove(np.array([known[name] for name in names.tolist() if name in known], dtype=np.int64))

    def _by_kind(
        self, belief: Belief, names: np.ndarray, members: np.ndarray
    ) -> list[tuple[CameraModel | GroupView, np.ndarray, np.ndarray]]:
        """Features (K,) by their model: the model, which of them, and the landmarks' ids."""
        known = self._names.ids(belief.catalogue)
        ids = np.array([known.get(name, -1) for name in names.tolist()], dtype=np.int64)
        own = np.flatnonzero((members < 0) & (ids >= 0))
        is_ray = belief.map.are(ids[own], self.inverse_depth)
        out: list[tuple[CameraModel | GroupView, np.ndarray, np.ndarray]] = []
        for model, chosen in ((self.point, own[~is_ray]), (self.ray, own[is_ray])):
            if chosen.size:
                out.append((model, chosen, ids[chosen]))
        of_group = np.flatnonzero(members >= 0)
        if of_group.size:
            out.append((self._view(belief, members[of_group]), of_group, np.array([known[CONSTELLATION]])))
        return out

    def _view(self, belief: Belief, places: np.ndarray) -> GroupView:
        assert self._start is not None
        group = belief.map.landmark_of(self._names.ids(belief.catalogue)[CONSTELLATION])
        if isinstance(group, Constellation):
            return ConstellationView(self.camera, self._start.points.positions[places])
        return MembersView(self.camera, places)

    def _constellation_group(
        self, frame: FeatureFrame, inside: np.ndarray, belief: Belief
    ) -> list[Observations]:
        """All known points that are seen, as one measurement; the first sight of them is in the map already."""
        names = frame.landmarks.tolist()
        rows = [k for k, name in enumerate(names) if name in self._place and inside[k]]
        if not rows or self._has_entered(frame, rows):
            return []
        landmark = self._names.ids(belief.catalogue)[CONSTELLATION]
        view = self._view(belief, np.array([self._place[names[k]] for k in rows]))
        z, cov = frame.z[rows].reshape(1, -1), np.zeros((1, view.dim, view.dim))
        for k, row in enumerate(rows):
            cov[0, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = frame.cov_z[row]
        return [Observations(z, cov, view, ids=np.array([landmark]))]

    def _has_entered(self, frame: FeatureFrame, rows: list[int]) -> bool:
        assert self._start is not None
        first = self._start.sight
        if frame.stamp_ns != first.stamp_ns:
            return False
        order = np.argsort(first.landmarks), np.argsort(frame.landmarks[rows])
        return np.array_equal(first.z[order[0]], frame.z[rows][order[1]])

    def _ray_groups(
        self, frame: FeatureFrame, belief: Belief, rows: np.ndarray, ids: np.ndarray, scaled: bool
    ) -> list[Observations]:
        """Of rays; `scaled` says whether points are seen that hold the scale, which else the prior of depth does."""
        deep = self._has_parallax(belief, ids)
        z, cov = frame.z[rows], frame.cov_z[rows]

        def group(
            model: CameraRay, chosen: np.ndarray, updates: frozenset[Part] = _BOTH
        ) -> list[Observations]:
            if not chosen.any():
                return []
            return [Observations(z[chosen], cov[chosen], model, ids=ids[chosen], updates=updates)]

        if self.rays.pose_update == "marginal":
            young = self.epipolar if scaled else self.ray
            return group(self.ray, deep) + group(young, ~deep, updates=_STATE)
        updates = group(self.ray, deep, updates=_MAP)
        if self.rays.pose_update == "off":
            return updates
        return group(self.epipolar, np.ones_like(deep), updates=_STATE) + updates

    def _has_parallax(self, belief: Belief, ids: np.ndarray) -> np.ndarray:
        """Whether the particle of highest weight sees depth move the image (K,), E06 §5.1, last paragraph."""
        state, mode = belief.state[belief.mode], belief.mode
        _, jac, _ = belief.map.innovations(self.ray, np.zeros((ids.size, 2)), ids, state, mode)
        by_rho = np.sqrt(np.square(jac.landmark[..., 2]).sum(axis=-1))
        return by_rho * self.rays.std_per_m >= self.rays.depth_parallax_px

    def _promote(self, belief: Belief, observed: Sequence[Observations]) -> None:
        updated = [g.ids for g in observed if g.model is self.ray and g.updates != _STATE]
        if not updated:
            return
        ids = np.concatenate([i for i in updated if i is not None])
        ready = belief.weights @ self.inverse_depth.ready(belief.read(ids))
        belief.map.promote(ids[ready >= self.rays.promote_weight], Point(3))


def _diagonal_blocks(cov: np.ndarray, count: int) -> np.ndarray:
    """Covariances (count, 2, 2) of single points from (count, 2, 2) itself or from (1, 2 count, 2 count)."""
    if cov.shape[0] == count and cov.shape[1] == 2:
        return cov
    blocks = cov[0].reshape(count, 2, count, 2)
    return np.array([blocks[k, :, k] for k in range(count)])
