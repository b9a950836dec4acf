"""Where in its whole map a stereo camera is, by the descriptors of what it sees: without a prediction.

Descriptors alone mistake some features, so that the matches must agree on one place. The consensus is that of visual odometry;
the map takes the place of the earlier pair, as a camera would see it that stands far enough back to have all matched
landmarks before it.
"""

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Belief
from rbpf.lie import SE3
from rbpf.motion.stereo_vo import VoConfig, estimate_motion
from rbpf.systems.stereo.sensor import TINY, StereoFrame, StereoSensor


def relocalise_globally(
    sensor: StereoSensor, frame: StereoFrame, belief: Belief, config: VoConfig
) -> tuple[np.ndarray, int] | None:
    """The place, in the world of the heaviest particle.

    Args:
        sensor: whose descriptors they are.
        frame: the pair.
        belief: where the landmarks are.
        config: of the consensus; `least_matches` are needed.

    Returns:
        world_from_camera (7,) and the number of landmarks that agree; None where too few do.
    """
    free = np.arange(len(frame.features)) if frame.free is None else np.flatnonzero(frame.free)
    names = sensor.index.match(frame.features.descriptors[free]).ids
    known = np.isin(names, sensor.proven())
    features, names = frame.features.take(free[known]), names[known]
    if names.size < config.least_matches:
        return None
    records = belief.read_mode(sensor.ids(belief, names))
    place, cov = records.mean[0], records.cov[0]
    middle = np.median(place, axis=0)
    far = np.linalg.norm(place - middle, axis=1).max()
    world_from_view = SE3.identity()
    world_from_view[4:] = middle - [0.0, 0.0, 2.0 * far]
    local = SE3.inverse_transform(world_from_view, place)
    slope = sensor.model.rig.jacobian(local)
    seen = gaussian.symmetrise(slope @ cov @ slope.mT) + TINY * np.eye(3)
    z, rng = sensor.model.rig.project(local), np.random.default_rng(sensor.manager.frame)
    found = estimate_motion(sensor.model.rig, z, features.z, seen, features.cov, rng, config=config)
    if not found.found:
        return None
    return SE3.compose(world_from_view, found.previous_camera_from_camera), int(found.inliers.sum())
