"""After a motion that was only assumed: the place is found again in the map before any particle moves.

The distribution of an assumed motion is a Gaussian, which can wait: as long as the map says nothing about where the
camera has come, it grows with every pair, and no particle is drawn from it. Drawn at once, a few hundred particles would
be decimetres apart, none of them within millimetres of the right place, and landmarks started then would be so, too.
"""

from typing import Any

import numpy as np

from rbpf import gaussian
from rbpf.core.filter import Filter
from rbpf.core.models import NULL, Belief
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_geometry import Matches
from rbpf.motion.stereo_vo import VoConfig, estimate_motion
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.landmarks import TINY, Landmarks, Pair
from rbpf.systems.stereo.odometry import DeadReckoning


def motion_for_update(
    filter_: Filter, landmarks: Landmarks[Any], view: Pair[Any], at: DeadReckoning, config: StereoConfig
) -> tuple[Odometry | None, str]:
    """By what the particles are moved at a pair after an assumed motion, and in words why.

    None where the map does not say yet where the camera is.

    A map that has not got so far that it could say where the camera is, is not waited for. A place that is found far
    from where the camera was assumed to go takes the place of the assumed mean: something has deceived the odometry.
    Its covariance stays, and leaves the rest to each particle's own map.
    """
    motion, least = at.since_update, config.map.min_agreeing
    if landmarks.seen_again().size < least:
        return motion, ""
    after = f"after {at.assumed} pair{'s'[: at.assumed > 1]} whose motion was only assumed"
    belief = filter_.expect(motion, view.stamp_ns)
    count = int((landmarks.associate(view, belief) != NULL).sum())
    if count < least:
        place = relocalise_globally(landmarks, view, belief, config.odometry.estimate, filter_.rng)
        if place is not None:
            count, heaviest = place[1], filter_.particles.state[belief.mode]
            motion = Odometry(SE3.between(heaviest, place[0]), motion.cov)
    if count >= least:
        return motion, f"the camera is found again by {count} landmarks of the map, {after}"
    if at.waiting >= config.recovery.patience:
        return motion, f"the camera is not found again in the map, which goes on from here, {after}"
    return None, ""


def relocalise_globally(
    landmarks: Landmarks[Any], view: Pair[Any], belief: Belief, config: VoConfig, rng: np.random.Generator
) -> tuple[np.ndarray, int] | None:
    """Where in its whole map a stereo camera is, by what its features look like: without a prediction.

    Appearance alone mistakes some features, so that the matches must agree on one place. The consensus is that of
    visual odometry; the map takes the place of the earlier pair, as a camera would see it that stands far enough back
    to have all matched landmarks before it.

    Returns:
        world_from_camera (7,) in the world of the heaviest particle, and the number of landmarks that agree; None where
        too few do.
    """
    ids = landmarks.match_globally(view)
    rows = np.flatnonzero(np.isin(ids, landmarks.seen_again()))
    if rows.size < config.min_matches:
        return None
    features, records = view.features.take(rows), belief.read_mode(ids[rows])
    place, cov = records.mean[0], records.cov[0]
    middle = np.median(place, axis=0)
    far = np.linalg.norm(place - middle, axis=1).max()
    world_from_view = SE3.identity()
    world_from_view[4:] = middle - [0.0, 0.0, 2.0 * far]
    local, rig = SE3.inverse_transform(world_from_view, place), landmarks.rig
    slope = rig.jacobian(local)
    cov_seen = gaussian.symmetrise(slope @ cov @ slope.mT) + TINY * np.eye(3)
    matches = Matches.checked(rig, rig.project(local), features.z, cov_seen, features.cov)
    found = estimate_motion(matches, rng, config=config)
    if not found.found:
        return None
    return SE3.compose(world_from_view, found.previous_camera_from_camera), int(found.inliers.sum())
