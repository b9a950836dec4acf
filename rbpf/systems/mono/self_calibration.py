"""A camera that calibrates itself: its focal lengths, k1 and k2 are members of the joint map's Gaussian.

They are constants beside the velocity (J. Civera et al. 2009), about the calibration that was given. What particles with maps
of their own have made of the first frames is bent by a wrong camera, and does not know it; so at the hand-over these
frames are adjusted in batch, with the camera, as in a start without known points, and the Gaussian about the optimum is the
joint map: all landmarks, the pose, the velocity and the camera with what they have in common.
"""

from dataclasses import dataclass, replace

import numpy as np

from rbpf import gaussian
from rbpf.core.filter import Filter
from rbpf.core.models import Records
from rbpf.core.particles import Particles, uniform_log_weights
from rbpf.lie import SE3, skew
from rbpf.maps.constellation import LEAST
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.sensors.feature_log import KnownPoints
from rbpf.systems.mono.adjustment import (
    MIN_FRAMES,
    FirstFrames,
    Known,
    Optimum,
    between,
    gathered,
    optimum,
    structure_of,
    tangents,
)
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.known_start import world_of
from rbpf.systems.system import Revision

NUMBERS = "fx", "fy", "k1", "k2"


@dataclass(frozen=True)
class FirstAdjustment:
    """The first frames, adjusted together with the camera."""

    best: Optimum
    names: np.ndarray  #: (F,) of the features.
    known: np.ndarray  #: (F,) bool, whose place was known beforehand.
    stamps_ns: np.ndarray  #: (T,) of the frames that took part.


def adjusted(
    first: FirstFrames, filter_: Filter, features: FeatureSensor, config: MonoConfig, given: KnownPoints | None
) -> FirstAdjustment | None:
    """The optimum downhill from where the particles are; None where the frames have too little in common."""
    belief = filter_.belief()

    def held(names: np.ndarray) -> np.ndarray:
        return belief.map.holds(names) | (features.members(names) >= 0)

    steps, names, seen = gathered(first.seen, features, held, config.start.max_frames)
    if steps.size < MIN_FRAMES or not seen.is_connected():
        return None
    which, position = features.positions(belief, names)
    ordered = np.empty_like(position)
    ordered[which] = position
    path = np.array(first.path)[steps]
    start = replace(structure_of(SE3.between(path[:1], path), ordered), tuned=np.zeros(len(NUMBERS)))
    seen = replace(seen, tuning=np.linalg.inv(config.self_calibration.cov()))
    world, is_known = world_of(filter_), np.zeros(names.size, dtype=bool)
    if world is not None and given is not None:
        _, at, row = np.intersect1d(names, given.names, return_indices=True)
        is_known[at] = True
        whitener = np.linalg.inv(gaussian.cholesky(given.cov[row] + LEAST * np.eye(3)))
        seen = replace(seen, known=Known(at, given.positions[row], whitener))
        start = replace(start, frame=world.mean[belief.mode])
    best = optimum(seen, config, start)
    if not (np.isfinite(best.cost) and np.isfinite(best.information).all()):
        return None
    return FirstAdjustment(best, names, is_known, seen.stamps_ns)


def begin(
    found: FirstAdjustment, new: Filter, rays: InverseDepth, config: MonoConfig, stamps_ns: np.ndarray
) -> Revision:
    """Gives a filter on an empty joint map the Gaussian about an optimum; returns what the path was at stamps (T,).

    The frame is the last camera. What is known well enough is a point in it, all else a ray from there.
    """
    joint = new.belief().map
    assert isinstance(joint, JointMap)
    at, cov = found.best.structure, np.linalg.inv(found.best.information)
    count, free = at.inverse.size, 6 * (len(at.path) - 1)
    size, end = len(cov), free + 3 * count
    of_pose = [np.eye(6, size, 6 * (t - 1)) if t else np.zeros((6, size)) for t in range(len(at.path))]

    # The poses in the world, which the known points' frame is or the first camera.
    world, by_world = at.path, np.array(of_pose)
    if at.frame is not None:
        world = SE3.between(at.frame, at.path)
        by_world[:, :, -6:] -= SE3.adjoint(SE3.inverse(world))

    # The velocity: the mean one between the last two frames, and its walk since.
    seconds = 1e-9 * float(found.stamps_ns[-1] - found.stamps_ns[-2])
    relative = SE3.between(at.path[-2], at.path[-1])
    moved = SE3.log(relative)
    apart = of_pose[-1] - SE3.adjoint(SE3.inverse(relative)) @ of_pose[-2]
    by_velocity = SE3.right_jacobian_inverse(moved) @ apart / seconds

    # Rays (u, v, q) from the last camera, and points: of directions c = Rᵀ(d − q t).
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
    settled = found.known | (std <= config.inverse_depth.promote_std_ratio * ahead[:, 2])
    points, others = rows[settled], rows[~settled & (c[:, 2] > 0.0) & (q > 0.0)]

    by_camera = np.eye(len(NUMBERS), size, end)
    slopes = [by_world[-1], by_velocity, by_camera, *by_point[points], *by_ray[others]]
    by_all = np.concatenate(slopes)
    whole = by_all @ cov @ by_all.T
    whole[6:12, 6:12] += np.diag(config.velocity.walk_std() ** 2) * seconds / 3.0
    joint.begin(1, new.lineage)
    for chosen, kind, mean in ((points, Point(3), point), (others, rays, ahead)):
        if chosen.size:
            const = SE3.identity((1, chosen.size)) if kind.anchored else None
            nothing = np.zeros((1, chosen.size, 3, 3))
            joint.add_records(Records(mean[None, chosen], nothing, const), kind, ids=found.names[chosen])
    substate = np.concatenate([moved / seconds, at.tuned])
    joint.begin_at(world[-1:], substate[None], found.names[np.concatenate([points, others])], whole[None])
    joint.resample(np.zeros(new.n, dtype=np.int64))
    new.particles = Particles(SE3.identity((new.n,)), uniform_log_weights(new.n))

    covs = by_world @ cov @ np.swapaxes(by_world, 1, 2)
    nearest = np.clip(np.searchsorted(found.stamps_ns, stamps_ns), 0, len(world) - 1)
    return Revision(stamps_ns, between(found.stamps_ns, world[None], stamps_ns)[:, 0], covs[nearest])
