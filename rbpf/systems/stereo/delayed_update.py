"""After a motion that was only assumed: the place is found again in the map before any particle moves.

The law of an assumed motion is a Gaussian, which can wait: as long as the map says nothing about where the camera has
come, it grows with every pair, and no particle is drawn from it. Drawn at once, a few hundred particles would be
decimetres apart, none of them within millimetres of the right place, and landmarks started then would be so, too.
"""

from typing import TYPE_CHECKING

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.systems.stereo.dead_reckoning import Reckoned

if TYPE_CHECKING:
    from rbpf.systems.stereo.run import StereoRun


def motion_for_update(run: "StereoRun", t: int, at: Reckoned) -> Odometry | None:
    """By what the particles are moved at pair t; None where the map does not say yet where the camera has come.

    A map that has not got so far that it could say it is not waited for.

    A place that is found far from where the camera was assumed to go takes the place of the law's mean: something has
    deceived the odometry. Its covariance stays, and leaves the rest to each particle's own map.
    """
    recovery, motion = run.config.recovery, at.since_update
    if not (recovery.used and at.assumed) or run.front_end.proven < run.config.map.agreeing:
        return motion
    belief = run.filter.expect(motion, int(run.stamps_ns[t]))
    after = f"after {at.assumed} pair{'s'[: at.assumed > 1]} whose motion was only assumed"
    count = run.front_end.recognised(belief)
    if count < run.config.map.agreeing:
        place = run.front_end.relocalise_globally(belief)
        if place is not None:
            count, heaviest = place[1], run.filter.particles.state[belief.mode]
            motion = Odometry(SE3.between(heaviest, place[0]), motion.cov)
    if count >= run.config.map.agreeing:
        run.notes.append(f"pair {t}: the camera is found again by {count} landmarks of the map, {after}")
        return motion
    if at.waiting >= recovery.patience:
        run.notes.append(
            f"pair {t}: the camera is not found again in the map, which goes on from here, {after}"
        )
        return motion
    return None
