"""One camera on a joint map: the particles' own maps begin, and one Gaussian of map, pose and velocity goes on.

As long as the baseline is hardly known, what is seen depends on the product of baseline and depth, which is far from
Gaussian: particles with maps of their own hold it. Once depths are known, what they hold is nearly one Gaussian, given the
path of each, and is taken into one: what was sampled becomes uncertainty, Mathematics (consolidation). From then on no
particle forgets, for none has a past.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import final

import numpy as np

from rbpf.core.checkpoint import load_arrays
from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Belief, Observations, Part, Records, Sensor
from rbpf.core.particles import Particles, take, uniform_log_weights
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import Consolidation, Systematic
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import MarginalVelocity
from rbpf.sensors.camera.points import CameraModel, CameraRay
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor, InverseDepthRays, UnknownDepth

LINEARISATIONS = 3
"""Of the proposal: moments of the samples hand on what a few weights cannot mend."""
LEAST_PARALLAX_PX = 3.0
"""Parallax of one standard deviation of depth from where on it is measured; before, it is considered."""
JOINT = "joint/mean"
"""In the checkpoint of a filter on a joint map."""
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


def are_known(belief: Belief, features: FeatureSensor, seen: FeatureFrame, ratio: float) -> bool:
    """Whether the depths of enough of what a frame has shown are known, to a fraction of them."""
    return seen.landmarks.size > 0 and features.depth_known(belief, seen.landmarks, ratio).mean() >= KNOWN_FRACTION


def is_joint(checkpoint: Path) -> bool:
    """Whether a checkpoint was saved after the map became a joint one; errors as `rbpf.core.checkpoint.load_arrays`."""
    return bool(load_arrays(checkpoint, JOINT))


def joint_filter(config: MonoConfig, rays: JointRays, sensor: Sensor, rng: np.random.Generator) -> Filter:
    """A filter on a joint map that holds nothing yet; the parametrisations are named in it."""
    joint = JointMap(SE3, (np.zeros(6), np.diag(config.velocity.start_std() ** 2)), config.compiled)
    joint.register(rays.landmark)
    consolidation = Consolidation(config.window, config.resampling.ess_threshold)
    return Filter(
        MarginalVelocity(config.velocity.walk_std()), sensor, joint, EkfProposal(iterations=LINEARISATIONS),
        n=config.particles, rng=rng, lag=1, consolidation=consolidation,
    )  # fmt: skip


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
    means, covs = velocity.mean[chosen], take(velocity.cov, chosen).mean(axis=0)
    world, cov = SE3.identity((n,)), np.zeros((n, 6 + 3 * names.size, 6 + 3 * names.size))
    if group is not None:
        known = own.landmark_of(int(names[0]))
        assert isinstance(known, Constellation | UncertainConstellation)
        records = _of(own.read(names[:1]), chosen)
        frame, cov = known.jointly(records)
        points = known.in_world(records)
        blocks = cov[:, 6:, 6:].reshape(n, names.size, 3, names.size, 3)
        each = np.arange(names.size)
        joint.add_records(Records(points, np.moveaxis(blocks[:, each, :, each], 0, 1)), Point(3), ids=names)
        # F⁻¹ moves by −Ad(F) dξ in its right chart.
        world, turn = SE3.inverse(frame), np.tile(np.eye(cov.shape[1]), (n, 1, 1))
        turn[:, :6, :6] = -SE3.adjoint(frame)
        cov = turn @ cov @ np.swapaxes(turn, 1, 2)
    joint.begin_at(world, (means, covs), names, cov)
    new.steps, new.stamp_ns = old.steps, old.stamp_ns
    here = joint.consolidate(Particles(particles.state[chosen], uniform_log_weights(n)))
    joint.resample(np.arange(new.n))  # they are all alike now
    new.particles = Particles(here.state[: new.n], uniform_log_weights(new.n))


def _of(records: Records, chosen: np.ndarray) -> Records:
    """Of some particles."""
    const = None if records.const is None else take(records.const, chosen)
    return Records(take(records.mean, chosen), take(records.cov, chosen), const)
