"""Points and rays from features that carry names: the measurement side of E06 without its images."""

from collections.abc import Sequence
from typing import final

import numpy as np

from rbpf.belief import Belief
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.point import Point
from rbpf.models import Births, Observations, Part, Sensor
from rbpf.sensors.camera_constellation import ConstellationView
from rbpf.sensors.camera_points import CameraPoint, CameraRay, EpipolarRay
from rbpf.sensors.features import FeatureFrame, KnownPoints
from rbpf.sensors.names import Names
from rbpf.sensors.pinhole import Pinhole
from rbpf.systems.mono.config import RayConfig

CONSTELLATION = -1
"""Name of the known points' frame in the catalogue; features have names from 0 on."""

_STATE, _MAP = frozenset({Part.STATE}), frozenset({Part.LANDMARK})
_BOTH = _STATE | _MAP


@final
class FeatureSensor(Sensor):
    """Landmarks start as rays, constrain the pose as `RayConfig` says, and become points when their depth is known.

    Args:
        camera: of the images.
        rays: settings of landmarks without depth.
        births_per_frame: landmarks started in one frame at most.
    """

    def __init__(
        self, camera: Pinhole, rays: RayConfig, births_per_frame: int, known: KnownPoints | None = None
    ) -> None:
        rho = (rays.rho_per_m, rays.std_rho_per_m)
        self.camera = camera
        self.rays = rays
        self.births_per_frame = births_per_frame
        self.point = CameraPoint(camera)
        self.ray = CameraRay(camera, rho)
        self.epipolar = EpipolarRay(camera, rho, rays.least_px)
        self.inverse_depth = InverseDepth(rays.ready_ratio)
        self._names = Names()
        self._known = known
        self._place = {} if known is None else {name: m for m, name in enumerate(known.names.tolist())}

    def observe(self, frame: FeatureFrame, belief: Belief) -> Sequence[Observations]:
        """Groups for points and for rays."""
        known = self._names.ids(belief.catalogue)
        ids = np.array([known.get(name, -1) for name in frame.landmarks.tolist()], dtype=np.int64)
        usable = (ids >= 0) & self.camera.inside(frame.z)
        rows = np.flatnonzero(usable)
        groups = self._constellation_group(frame, belief)
        is_ray = belief.map.are(ids[rows], self.inverse_depth)
        if (~is_ray).any():
            k = rows[~is_ray]
            groups.append(Observations(frame.z[k], frame.cov_z[k], self.point, ids=ids[k]))
        if is_ray.any():
            groups += self._ray_groups(frame, belief, rows[is_ray], ids[rows[is_ray]])
        return groups

    def births(
        self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[Births]:
        """Promotes rays that are ready; starts a ray for every new name."""
        self._promote(belief, observed)
        known = self._names.ids(belief.catalogue)
        names = frame.landmarks.tolist()
        new = [k for k, name in enumerate(names) if name not in known and name not in self._place]
        new = [k for k in new if self.camera.inside(frame.z[k])][: self.births_per_frame]
        if not new:
            return []
        names = frame.landmarks[new].tolist()
        return [Births(frame.z[new], frame.cov_z[new], self.ray, self.inverse_depth, facts=names)]

    def _constellation_group(self, frame: FeatureFrame, belief: Belief) -> list[Observations]:
        """All known points that are seen, as one measurement of their frame."""
        rows = [k for k, name in enumerate(frame.landmarks.tolist()) if name in self._place]
        rows = [k for k in rows if self.camera.inside(frame.z[k])]
        if not rows:
            return []
        assert self._known is not None
        landmark = self._names.ids(belief.catalogue)[CONSTELLATION]
        places = np.array([self._place[name] for name in frame.landmarks[rows].tolist()])
        own = None if belief.map.landmark_of(landmark).dim == 6 else places
        view = ConstellationView(self.camera, self._known.positions[places], own)
        z, cov = frame.z[rows].reshape(1, -1), np.zeros((1, view.dim, view.dim))
        for k, row in enumerate(rows):
            cov[0, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = frame.cov_z[row]
        return [Observations(z, cov, view, ids=np.array([landmark]))]

    def _ray_groups(
        self, frame: FeatureFrame, belief: Belief, rows: np.ndarray, ids: np.ndarray
    ) -> list[Observations]:
        deep = self._has_parallax(belief, ids)
        z, cov = frame.z[rows], frame.cov_z[rows]

        def group(
            model: CameraRay, chosen: np.ndarray, informs: frozenset[Part] = _BOTH
        ) -> list[Observations]:
            if not chosen.any():
                return []
            return [Observations(z[chosen], cov[chosen], model, ids=ids[chosen], informs=informs)]

        if self.rays.constrain == "marginal":
            return group(self.ray, deep) + group(self.ray, ~deep, informs=_STATE)
        updates = group(self.ray, deep, informs=_MAP)
        if self.rays.constrain == "off":
            return updates
        return group(self.epipolar, np.ones_like(deep), informs=_STATE) + updates

    def _has_parallax(self, belief: Belief, ids: np.ndarray) -> np.ndarray:
        """Whether the particle of highest weight sees depth move the image (K,), E06 §5.1, last paragraph."""
        records, mode = belief.read(ids), belief.mode
        assert records.const is not None
        jacobians = self.ray.jacobians(belief.state[mode], records.mean[mode], records.const[mode])
        assert jacobians.landmark is not None
        by_rho = np.sqrt(np.square(jacobians.landmark[..., 2]).sum(axis=-1))
        return by_rho * self.rays.std_rho_per_m >= self.rays.least_px

    def _promote(self, belief: Belief, observed: Sequence[Observations]) -> None:
        updated = [g.ids for g in observed if g.model is self.ray and g.informs != _STATE]
        if not updated:
            return
        ids = np.concatenate([i for i in updated if i is not None])
        ready = belief.weights @ self.inverse_depth.ready(belief.read(ids))
        belief.map.promote(ids[ready >= self.rays.ready_weight], Point(3))
