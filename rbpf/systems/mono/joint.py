"""One camera on a joint map: starts with per-particle maps, and continues with one Gaussian of map, pose and velocity.

While the baseline is uncertain, measurements depend on the product of baseline and depth, which is far from Gaussian:
per-particle maps represent it. Once depths are known, all frames so far are adjusted in batch, with the camera for
self-calibration, and the Gaussian at the optimum is the joint map: landmarks, pose, velocity and camera with their
correlations. It is initialised again as long as later frames add much information. Its particles lose no information by
resampling, as none has a past.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import integers, load_arrays, read_one
from rbpf.core.filter import Filter
from rbpf.core.models import Belief, Observations, Part, Records
from rbpf.core.particles import Particles, uniform_log_weights
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import Consolidation
from rbpf.errors import InputError
from rbpf.lie import SE3, skew
from rbpf.maps.constellation import LEAST
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import MarginalVelocity
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame, KnownPoints
from rbpf.systems.learnt_noise import RIGHT, LearntNoise
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor, InverseDepthRays, UnknownDepth
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.start.adjustment import (
    Adjusted,
    FirstFrames,
    Known,
    Optimum,
    Window,
    between,
    gathered,
    minima,
    optimum,
    residual_px,
    tangents,
)
from rbpf.systems.mono.start.known import KnownStart
from rbpf.systems.system import Revision

LINEARISATIONS = 3  #: Of the proposal: errors that a few weights cannot correct would persist in the moments.
#: Standard deviations: after a linearisation that moved a mean by this, the next one moves it by a hundredth of it.
SETTLED = 0.2
JOINT = "joint/mean"  #: An array in every checkpoint of a filter on a joint map.
#: Maximum number of first frames in the adjustment that starts the joint map, its only source of information.
MAX_FRAMES = 150
#: Number of self-calibration constants, added to the velocity in the substate (J. Civera et al. 2009).
NUMBERS = "fx", "fy", "k1", "k2"
KNOWN_FRACTION = 0.5  #: Fraction of the features in view with known depth at which the joint map starts.


@final
class JointRays(InverseDepthRays):
    """Rays with an inverse depth in a joint map, which has their anchors: all use the full measurement."""

    def observations(
        self, belief: Belief, z: np.ndarray, cov: np.ndarray, ids: np.ndarray, scaled: bool, held: bool
    ) -> list[Observations]:
        return [Observations(z, cov, self.model, ids=ids)]

    def promotable(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        ids = belief.map.ids
        rays = ids[belief.map.are(ids, self.landmark)]
        if not rays.size:
            return rays
        return np.asarray(rays[belief.weights @ self.landmark.ready(belief.read(rays)) >= self.config.promote_weight])


@final
class HandOver:
    """Decides when the joint map starts, and creates its filter.

    Args:
        config: all settings.
        camera: the given camera.
        known: the known points, or None.
        rays: storage of features of unknown depth.
        fixed: whether the map is a fixed known one, which is never joint.
        first: the frames so far, kept until the joint map starts.

    Raises InputError: a requested joint map is not possible.
    """

    def __init__(
        self,
        config: MonoConfig,
        camera: Pinhole,
        known: KnownPoints | None,
        rays: UnknownDepth,
        fixed: bool,
        first: FirstFrames,
    ) -> None:
        own, velocity = isinstance(rays, InverseDepthRays), config.velocity.mode
        fits = own and velocity == "marginal" and config.lag is None
        wanted = not fixed and (config.map == "joint" or (config.map == "auto" and fits))
        if wanted and velocity != "marginal":
            raise InputError(f"a joint map holds the velocity: set velocity.mode=marginal, not {velocity}")
        self.config, self.camera, self.known, self.first = config, camera, known, first
        self.joint: JointMap | None = None  #: The joint map; None while every particle has its own map.
        self._rays: JointRays | None = None
        self.noise: LearntNoise | None = None
        if wanted and config.noise != "stated":
            # With an uncertain calibration, common residuals are not noise.
            level = 0.0 if config.noise == "learnt" else RIGHT**2
            self.noise = LearntNoise(shared=True, right=np.inf if config.calibrate == "online" else level)
        if wanted:
            if not isinstance(rays, InverseDepthRays):
                raise InputError(f"a joint map needs features as rays with inverse depth, not {type(rays).__name__}")
            self._rays = JointRays(rays.camera, rays.config)
        self._settled = 0  # consecutive frames with known depths
        self._numbers = NUMBERS if config.calibrate == "online" else ()  # of estimated camera constants
        if self._numbers and (self._rays is None or config.known != "frame"):
            raise InputError(
                "calibrate=online holds the camera in a joint map that a run makes itself: leave out map=particles, lag, a "
                "map to be found in, velocity modes but marginal, and known=points"
            )

    @property
    def is_ahead(self) -> bool:
        """Whether the joint map will still start or restart; not once landmarks have moved to an old sub-map."""
        has_left = self.joint is not None and len(self.joint.old.maps) > 0
        return self._rays is not None and self._settled < self.config.settled_frames and not has_left

    def after_frame(self, filter_: Filter, sensor: ImageSensor, seen: FeatureFrame) -> Adjusted | None:
        """To be called after a tracked frame; returns the filter on the joint map when it is due.

        It is due once depths are known. If known points determine the baseline, a first one starts earlier: each image alone
        leaves two similar motions, and a few particles may all take the wrong one.
        """
        if not self.is_ahead:
            return None
        self.first.thin(MAX_FRAMES)
        ratio, belief = self.config.inverse_depth.promote_std_ratio, filter_.belief()
        known = sensor.features.depth_known(belief, seen.landmarks, ratio)
        self._settled = self._settled + 1 if known.size and known.mean() >= KNOWN_FRACTION else 0
        is_early = self.known is not None and self.joint is None and self.config.start.is_due(len(self.first.stamps_ns))
        if self.is_ahead and not is_early:
            return None
        adjusted = self.become(sensor, filter_, if_known=self.is_ahead)
        if adjusted is None and self._settled == self.config.settled_frames:
            self._settled -= 1  # the next frame tries again
        return adjusted

    def become(
        self, sensor: ImageSensor, filter_: Filter, reverse: bool = False, if_known: bool = False
    ) -> Adjusted | None:
        """The filter on a joint map, from an adjustment of the frames so far; None if they do not determine one yet.

        With `reverse` the depth-reversed solution is tried, too (`minima`). With `if_known`, half of the depths in view must
        be known after it; if not, the next adjustment starts from this one.
        """
        assert self._rays is not None
        found = self._adjusted(filter_, sensor.features, reverse)
        if found is None:
            return None
        if if_known:
            names, seen, best = found
            in_view = np.isin(names, self.first.seen[-1].landmarks)
            if not best.depth_std_ratio(in_view) < self.config.inverse_depth.promote_std_ratio:
                self.first.path = list(between(seen.stamps_ns, best.structure.path[None], self._kept_ns())[:, 0])
                return None
        new = self._new_filter(self._rays, sensor, filter_.rng)
        new.steps, new.stamp_ns, new.log_evidence = filter_.steps, filter_.stamp_ns, filter_.log_evidence
        revision = self._begin(self._use(new, self._rays, sensor), *found)
        self.tune(new, sensor)
        kept = np.searchsorted(self.first.stamps_ns, self._kept_ns())
        self.first.path, self.first.last = list(revision.poses[kept]), revision.poses[-1]
        return Adjusted(new, revision, self.first.seen_first(revision.poses))

    def _kept_ns(self) -> np.ndarray:
        return np.array([frame.stamp_ns for frame in self.first.seen])

    def _adjusted(
        self, filter_: Filter, features: FeatureSensor, reverse: bool = False
    ) -> tuple[np.ndarray, Window, Optimum] | None:
        """Names (F,), their observations, and the optimum reached from the particles; None if there is none."""
        belief, config, given = filter_.belief(), self.config, self.known
        found = gathered(self.first, features, belief, MAX_FRAMES, min_views=1)
        if found is None:
            return None
        _, names, seen, start = found
        if self.joint is not None and not seen.is_connected():
            self._settled = config.settled_frames + 1  # features that connect the frames have left the map: no restart
            return None
        if self._numbers:
            seen = replace(seen, camera=self.camera, tuning=np.linalg.inv(config.self_calibration.cov()))
            start = replace(start, tuned=np.zeros(len(self._numbers)))
        if given is not None:
            _, at, row = np.intersect1d(names, given.names, return_indices=True)
            whitener = np.linalg.inv(gaussian.cholesky(given.cov[row] + LEAST * np.eye(3)))
            seen = replace(seen, known=Known(at, given.positions[row], whitener))
            world_from_first = KnownStart.from_frame(self.camera, given, self.first.seen[0]).world_from_camera
            start = replace(start, frame=SE3.inverse(world_from_first))
            # As for the particles' rays: the scene has about the depth of the known points.
            assert self._rays is not None
            away = np.linalg.norm(SE3.inverse_transform(world_from_first, given.positions[row]), axis=1)
            mean, std = self._rays.prior(away)
            config = replace(config, inverse_depth=replace(config.inverse_depth, mean_per_m=mean, std_per_m=std))
        best = min(minima(seen, config, start, reverse), key=lambda each: each.cost, default=None)
        if best is not None and self.noise is not None:
            # The first frames cannot show that the noise is smaller than stated, as errors grow with the change of view.
            noise_px = residual_px(seen, config, best)
            is_noisier = (noise_px / seen.noise_px) ** 2 > max(RIGHT**2, self.noise.right)
            # The result of an earlier unsuccessful attempt is discarded, as checkpoints do not have it.
            self.noise.expect((noise_px / seen.noise_px) ** 2 if is_noisier else 1.0)
            if is_noisier:
                best = optimum(replace(seen, noise_px=noise_px), config, best.structure)
        return None if best is None else (names, seen, best)

    def tune(self, filter_: Filter, sensor: ImageSensor) -> None:
        """Sets the camera to the particles' mean calibration; without self-calibration it is unchanged."""
        substate = None if self.joint is None else self.joint.driving()
        if self._numbers and substate is not None:
            about = filter_.particles.weights @ substate
            sensor.features.tune(self.camera.tuned(about[6:]), about)

    def calibration(self, filter_: Filter) -> tuple[Pinhole, np.ndarray] | None:
        """The estimated camera, and standard deviations (4,) of log fx, log fy, k1 and k2; None without self-calibration."""
        if not self._numbers or self.joint is None:
            return None
        mean, cov = self.joint.moments(filter_.particles, Part.SUBSTATE)
        std = np.sqrt(np.diagonal(cov)[6:])
        return (self.camera.tuned(mean[6:]), std) if std.all() else None

    def taken_up(self, checkpoint: Path, sensor: ImageSensor, rng: np.random.Generator) -> Filter | None:
        """The filter for a checkpoint that was saved with a joint map, else None; errors as of `load_arrays`."""
        if self._rays is None or self.joint is not None or not load_arrays(checkpoint, JOINT):
            return None
        return self._use(self._new_filter(self._rays, sensor, rng), self._rays, sensor)

    def hold(self, filter_: Filter, blind: bool) -> None:
        """Keeps the joint map's frame fixed while nothing is measured: it would take on the uncertainty of the motion."""
        due = filter_.consolidation
        if due is not None and due.held != blind:
            filter_.consolidation = replace(due, held=blind)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        learnt = {} if self.noise is None or self.joint is None else self.noise.arrays()
        return {} if self._rays is None else {"mono/settled": np.array(self._settled), **learnt}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        if self._rays is not None:
            self._settled = int(read_one(arrays, "mono/settled", integers(least=0)))
        if self.noise is not None and self.joint is not None:
            self.noise.restore(arrays)

    def _new_filter(self, rays: JointRays, sensor: ImageSensor, rng: np.random.Generator) -> Filter:
        """A filter on an empty joint map with registered parametrisations."""
        config = self.config
        constants = len(self._numbers)
        variances = np.pad(config.velocity.start_std() ** 2, (0, constants))
        before = np.zeros(variances.size), np.diag(variances)
        joint = JointMap(SE3, before, config.compiled, config.submap, constants=constants)
        joint.register(rays.landmark)
        consolidation = Consolidation(config.window, config.resampling.ess_threshold)
        motion = MarginalVelocity(config.velocity.walk_std(), constants)
        proposal = EkfProposal(iterations=LINEARISATIONS, settled=SETTLED)
        return Filter(
            motion, sensor, joint, proposal, n=config.particles, rng=rng, lag=1, consolidation=consolidation
        )  # fmt: skip

    def _use(self, filter_: Filter, rays: JointRays, sensor: ImageSensor) -> Filter:
        joint = filter_.belief().map
        assert isinstance(joint, JointMap)
        self.joint = joint
        search = self.config.search
        sensor.features.become_joint(rays, search.max_radius_px / search.ellipse_sigmas, self.noise)
        return filter_

    def _begin(self, new: Filter, names: np.ndarray, seen: Window, best: Optimum) -> Revision:
        """Initialises a filter's joint map with the Gaussian at an optimum of features (F,); returns the revised path.

        The map's frame is the last camera. Features of known depth become points in it, others rays from there.
        """
        joint, config = self.joint, self.config
        assert joint is not None and self._rays is not None
        at, cov, times = best.structure, np.linalg.inv(best.information), seen.stamps_ns
        count, free = at.inverse.size, 6 * (len(at.path) - 1)
        size, end = len(cov), free + 3 * count
        of_pose = [np.eye(6, size, 6 * (t - 1)) if t else np.zeros((6, size)) for t in range(len(at.path))]

        # The poses in the world: the known points' frame, or the first camera.
        world, by_world = at.path, np.array(of_pose)
        if at.frame is not None:
            world = SE3.between(at.frame, at.path)
            by_world[:, :, -6:] -= SE3.adjoint(SE3.inverse(world))

        # The velocity: the mean between the last two frames, and its random walk since.
        seconds = 1e-9 * float(times[-1] - times[-2])
        relative = SE3.between(at.path[-2], at.path[-1])
        moved = SE3.log(relative)
        apart = of_pose[-1] - SE3.adjoint(SE3.inverse(relative)) @ of_pose[-2]
        by_velocity = SE3.right_jacobian_inverse(moved) @ apart / seconds

        # Rays (u, v, q) from the last camera, and points, from directions c = Rᵀ(d − q t).
        pose, q = at.path[-1], at.inverse
        back = SE3.rotation(pose).T
        c = SE3.inverse_transform(pose, at.direction + (1.0 - q[:, None]) * SE3.translation(pose))
        by_c = np.concatenate([skew(c), -q[:, None, None] * np.eye(3)], axis=2) @ of_pose[-1]
        by_q, rows = np.zeros((count, 1, size)), np.arange(count)
        for f in rows.tolist():
            own = slice(free + 3 * f, free + 3 * f + 3)
            by_c[f, :, own] += back @ np.column_stack([tangents(at.direction[f : f + 1])[0], -SE3.translation(pose)])
            by_q[f, 0, own] = 0.0, 0.0, 1.0
        ahead = np.concatenate([c[:, :2], q[:, None]], axis=1) / c[:, 2:]
        by_ray = (np.concatenate([by_c[:, :2], by_q], axis=1) - ahead[..., None] * by_c[:, 2:]) / c[:, 2:, None]
        point = c / q[:, None]
        by_point = (by_c - point[..., None] * by_q) / q[:, None, None]
        std = np.sqrt(np.einsum("fi,ij,fj->f", by_ray[:, 2], cov, by_ray[:, 2]))
        settled = std <= config.inverse_depth.promote_std_ratio * ahead[:, 2]
        if seen.known is not None:
            settled[seen.known.feature] = True
        points, others = rows[settled], rows[~settled & (c[:, 2] > 0.0) & (q > 0.0)]

        by_camera = np.eye(at.tuned.size, size, end)
        slopes = [by_world[-1], by_velocity, by_camera, *by_point[points], *by_ray[others]]
        by_all = np.concatenate(slopes)
        whole = by_all @ cov @ by_all.T
        whole[6:12, 6:12] += np.diag(config.velocity.walk_std() ** 2) * seconds / 3.0
        joint.begin(1, new.lineage)
        for chosen, kind, mean in ((points, Point(3), point), (others, self._rays.landmark, ahead)):
            if chosen.size:
                const = SE3.identity((1, chosen.size)) if kind.anchored else None
                nothing = np.zeros((1, chosen.size, 3, 3))
                joint.add_records(Records(mean[None, chosen], nothing, const), kind, ids=names[chosen])
        substate = np.concatenate([moved / seconds, at.tuned])
        joint.begin_at(world[-1], substate, names[np.concatenate([points, others])], whole)
        joint.resample(np.zeros(new.n, dtype=np.int64))
        new.particles = Particles(SE3.identity((new.n,)), uniform_log_weights(new.n))

        covs = by_world @ cov @ np.swapaxes(by_world, 1, 2)
        stamps_ns = np.array(self.first.stamps_ns)
        nearest = np.clip(np.searchsorted(times, stamps_ns), 0, len(world) - 1)
        return Revision(stamps_ns, between(times, world[None], stamps_ns)[:, 0], covs[nearest])
