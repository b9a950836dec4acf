"""One camera on a joint map: the particles' own maps begin, and one Gaussian of map, pose and velocity goes on.

As long as the baseline is hardly known, what is seen depends on the product of baseline and depth, which is far from
Gaussian: particles with maps of their own hold it. Once depths are known, what they hold is nearly one Gaussian, given the
path of each, and is taken into one: what was sampled becomes uncertainty, Mathematics (consolidation). From then on no
particle forgets, for none has a past.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, final

import numpy as np

from rbpf.core.checkpoint import integers, load_arrays, read_one
from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Belief, Observations, Part, Records
from rbpf.core.particles import Particles, take, uniform_log_weights
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import Consolidation, Systematic
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import MarginalVelocity
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraModel, CameraRay
from rbpf.sensors.feature_log import FeatureFrame, KnownPoints
from rbpf.systems.mono.adjustment import FirstFrames
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor, InverseDepthRays, UnknownDepth
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.known_start import world_of
from rbpf.systems.mono.self_calibration import NUMBERS, adjusted, begin
from rbpf.systems.system import Revision

LINEARISATIONS = 3
"""Of the proposal: moments of the samples hand on what a few weights cannot mend."""
SETTLED = 0.2
"""Standard deviations: a linearisation after one that moved a mean by so much moves it by a hundredth of that."""
LEAST_PARALLAX_PX = 3.0
"""Parallax of one standard deviation of depth from where on it is measured; before, it is considered."""
JOINT = "joint/mean"
"""In the checkpoint of a filter on a joint map."""
LONGEST = 1000
"""Frames that are kept to be adjusted with the camera, at most; a start that takes longer leaves it as it is given."""
UNCALIBRATED = "the first frames have too little in common to calibrate the camera by: it is taken as it was given"
KNOWN_FRACTION = 0.5
"""Of the features in view: so many depths are known when the map becomes a joint one."""


@final
class JointRays(UnknownDepth):
    """Rays with an inverse depth in a joint map, which holds where they were seen first: each is observed as it is."""

    landmark: InverseDepth
    model: CameraRay

    def __init__(self, own: InverseDepthRays) -> None:
        self.own, self.model = own, own.model
        self.landmark = InverseDepth(own.config.promote_std_ratio, LEAST_PARALLAX_PX)

    def tune(self, camera: Pinhole, about: np.ndarray) -> None:
        self.own.tune(camera, about)
        self.model = self.own.model

    def starting(self, depths: np.ndarray) -> CameraModel:
        return self.own.starting(depths)

    def observations(
        self, belief: Belief, z: np.ndarray, cov: np.ndarray, ids: np.ndarray, scaled: bool, held: bool
    ) -> list[Observations]:
        return [Observations(z, cov, self.model, ids=ids)]

    def promotable(self, belief: Belief, observed: Sequence[Observations]) -> np.ndarray:
        ids = belief.map.ids
        rays = ids[belief.map.are(ids, self.landmark)]
        if not rays.size:
            return rays
        return np.asarray(
            rays[belief.weights @ self.landmark.ready(belief.read(rays)) >= self.own.config.promote_weight]
        )

    def depth_std_ratio(self, records: Records) -> np.ndarray:
        return self.own.depth_std_ratio(records)

    def extent(self, records: Records, sigmas: float, min_weight: float = 0.0) -> np.ndarray:
        return self.own.extent(records, sigmas, min_weight)


class HandedOver(NamedTuple):
    """The filter on the joint map; where the first frames were adjusted once more what they say of all poses; and words."""

    filter: Filter
    revision: Revision | None = None
    words: str | None = None


@final
class HandOver:
    """Whether and when the map becomes a joint one, and the filter that goes on with it.

    Args:
        config: all settings.
        camera: as it is given.
        known: the known points, where there are some.
        rays: how features are kept as long as their depth is not known.
        fixed: whether the map was made before and is not changed; it is then never joint.

    Raises InputError: a joint map is asked for that cannot be.
    """

    def __init__(
        self, config: MonoConfig, camera: Pinhole, known: KnownPoints | None, rays: UnknownDepth, fixed: bool
    ) -> None:
        own, velocity = isinstance(rays, InverseDepthRays), config.velocity.mode
        fits = own and velocity == "marginal" and config.lag is None
        wanted = not fixed and (config.map == "joint" or (config.map == "auto" and fits))
        if wanted and velocity != "marginal":
            raise InputError(f"a joint map holds the velocity: set velocity.mode=marginal, not {velocity}")
        self.config, self.camera, self.known = config, camera, known
        self.joint: JointMap | None = None
        """The joint map; None as long as every particle has a map of its own."""
        self.particles = max(config.particles, config.starting_particles) if wanted else config.particles
        """So many begin."""
        self._rays: JointRays | None = None
        if wanted:
            if not isinstance(rays, InverseDepthRays):
                raise InputError(f"a joint map keeps features as rays with inverse depth, not as {type(rays).__name__}")
            self._rays = JointRays(rays)
        self._settled = 0  # frames in a row in which depths were known
        self.first = None if config.calibrate == "off" else FirstFrames()
        """Of a camera that calibrates itself, until the hand-over."""
        if self.first is not None and (self._rays is None or config.known != "frame"):
            raise InputError(
                "calibrate=online holds the camera in a joint map that a run makes itself: leave out map=particles, lag, a "
                "map to be found in, velocity modes but marginal, and known=points"
            )

    def note(self, seen: FeatureFrame, pose: np.ndarray, revision: Revision | None) -> None:
        """What was measured in a frame, and from where (7,) in the particles' world; earlier poses may be revised."""
        if self.first is None or self.joint is not None or len(self.first.seen) == LONGEST:
            return
        self.first.seen.append(seen)
        self.first.path.append(pose)
        if revision is not None:
            self.first.path = list(revision.poses)

    def after_frame(self, filter_: Filter, sensor: ImageSensor, seen: FeatureFrame) -> HandedOver | None:
        """Takes note of what a frame has shown that was tracked; the filter on the joint map, when it is time for it."""
        if self._rays is None or self.joint is not None:
            return None
        ratio, belief = self.config.inverse_depth.promote_std_ratio, filter_.belief()
        known = sensor.features.depth_known(belief, seen.landmarks, ratio)
        self._settled = self._settled + 1 if known.size and known.mean() >= KNOWN_FRACTION else 0
        return self.become(filter_, sensor) if self._settled >= self.config.settled_frames else None

    def become(self, filter_: Filter, sensor: ImageSensor) -> HandedOver:
        """The filter on a joint map of what the particles hold; its world is that of the known points, if there are some."""
        assert self._rays is not None
        new, world, features = self._new_filter(self._rays, sensor, filter_.rng), world_of(filter_), sensor.features
        new.steps, new.stamp_ns, new.log_evidence = filter_.steps, filter_.stamp_ns, filter_.log_evidence
        found = None
        if self.first is not None and len(self.first.seen) < LONGEST:
            found = adjusted(self.first, filter_, features, self.config, self.known)
        if self.first is None or found is None:
            hand_over(filter_, features, self._rays, new)
            if world is not None:
                sensor.move(SE3.inverse(world.mean[filter_.belief().mode]))
            words = None if self.first is None else UNCALIBRATED
            return HandedOver(self._use(new, self._rays, sensor), words=words)
        stamps = np.array([frame.stamp_ns for frame in self.first.seen])
        revision = begin(found, new, self._rays.landmark, self.config, stamps)
        self._use(new, self._rays, sensor)
        self.tune(new, sensor)
        if len(sensor.table):
            sensor.resampled(new.belief(), revision.poses, self.first.frame_of())
            sensor.table.member[:] = -1
        self.first = FirstFrames()
        return HandedOver(new, revision)

    def tune(self, filter_: Filter, sensor: ImageSensor) -> None:
        """The camera is taken to be what it is on the average of the particles; nothing is done to one that is given."""
        substate = None if self.joint is None else self.joint.driving()
        if self.first is not None and substate is not None:
            about = filter_.particles.weights @ substate
            sensor.features.tune(self.camera.tuned(about[6:]), about)

    def calibration(self, filter_: Filter) -> tuple[Pinhole, np.ndarray] | None:
        """The camera as it is estimated, and standard deviations (4,) of log fx, log fy, k1 and k2; None: it is given."""
        if self.first is None or self.joint is None:
            return None
        mean, cov = self.joint.moments(filter_.particles, Part.SUBSTATE)
        std = np.sqrt(np.diagonal(cov)[6:])
        return (self.camera.tuned(mean[6:]), std) if std.all() else None

    def taken_up(self, checkpoint: Path, sensor: ImageSensor, rng: np.random.Generator) -> Filter | None:
        """The filter that a checkpoint is of, if it was saved on a joint map; errors as `load_arrays`."""
        if self._rays is None or self.joint is not None or not load_arrays(checkpoint, JOINT):
            return None
        return self._use(self._new_filter(self._rays, sensor, rng), self._rays, sensor)

    def hold(self, filter_: Filter, lost: bool) -> None:
        """The joint map's frame stays where it is while the camera is lost."""
        due = filter_.consolidation
        if due is not None and due.held != lost:
            filter_.consolidation = replace(due, held=lost)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        first = {} if self.first is None else self.first.arrays()
        settled = {} if self._rays is None else {"mono/settled": np.array(self._settled)}
        return settled | {f"mono/first/{name}": array for name, array in first.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        if self._rays is not None:
            self._settled = int(read_one(arrays, "mono/settled", integers(least=0)))
        if self.first is not None:
            self.first = FirstFrames.restored(arrays, "mono/first/")

    def _new_filter(self, rays: JointRays, sensor: ImageSensor, rng: np.random.Generator) -> Filter:
        """On a joint map that holds nothing yet; the parametrisations are named in it."""
        config = self.config
        constants = 0 if self.first is None else len(NUMBERS)
        variances = np.pad(config.velocity.start_std() ** 2, (0, constants))
        joint = JointMap(SE3, (np.zeros(variances.size), np.diag(variances)), config.compiled, config.submap)
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
        sensor.features.become_joint(rays, self.config.submap, search.max_radius_px / search.ellipse_sigmas)
        return filter_


def hand_over(old: Filter, features: FeatureSensor, rays: JointRays, new: Filter) -> None:
    """Gives a filter on a joint map what the particles of another one hold, with their own maps.

    Given its path, each particle's landmarks and velocity are Gaussians of its own, independent of each other, about means
    that the paths correlate; the known points are members of one, from whose frame the world is seen.
    """
    own, joint = old.belief().map, new.belief().map
    assert isinstance(joint, JointMap)
    n, particles = old.n, old.particles
    chosen = Systematic().ancestors(particles.weights, old.rng)
    joint.begin(n, new.lineage)
    ids, group = own.ids, features.group
    names = np.zeros(0, dtype=np.int64) if group is None else group.names

    # What stands for itself.
    is_ray = own.are(ids, features.unknown_depth.landmark)
    is_point = own.are(ids, Point(3))
    for kind, landmarks in ((Point(3), ids[is_point]), (rays.landmark, ids[is_ray])):
        if landmarks.size:
            joint.add_records(_of(own.read(landmarks), chosen), kind, ids=landmarks)

    # The velocity; and the known points, in whose frame the world is.
    velocity = old.marginals.parts[Part.SUBSTATE]
    assert isinstance(velocity, KalmanSubstate)
    means, covs = velocity.mean[chosen], take(velocity.cov, chosen)
    held = joint.driving()
    assert held is not None
    first = 6 + held.shape[1]  # numbers beside the velocity are left as they are, and certain
    world, cov = SE3.identity((n,)), np.zeros((n, first + 3 * names.size, first + 3 * names.size))
    if group is not None:
        known = own.landmark_of(int(names[0]))
        assert isinstance(known, Constellation | UncertainConstellation)
        records = _of(own.read(names[:1]), chosen)
        frame, together = known.jointly(records)
        points = known.in_world(records)
        blocks = together[:, 6:, 6:].reshape(n, names.size, 3, names.size, 3)
        each = np.arange(names.size)
        joint.add_records(Records(points, np.moveaxis(blocks[:, each, :, each], 0, 1)), Point(3), ids=names)
        # F⁻¹ moves by −Ad(F) dξ in its right chart.
        world, turn = SE3.inverse(frame), np.tile(np.eye(together.shape[1]), (n, 1, 1))
        turn[:, :6, :6] = -SE3.adjoint(frame)
        others = np.delete(np.arange(cov.shape[1]), np.arange(6, first))
        cov[:, others[:, None], others] = turn @ together @ np.swapaxes(turn, 1, 2)
    cov[:, 6:12, 6:12] = covs
    joint.begin_at(world, np.pad(means, ((0, 0), (0, first - 12))), names, cov)
    here = joint.consolidate(Particles(particles.state[chosen], uniform_log_weights(n)))
    joint.resample(np.arange(new.n))  # they are all alike now
    new.particles = Particles(here.state[: new.n], uniform_log_weights(new.n))


def _of(records: Records, chosen: np.ndarray) -> Records:
    """Of some particles."""
    const = None if records.const is None else take(records.const, chosen)
    return Records(take(records.mean, chosen), take(records.cov, chosen), const)
