"""After a motion that was only assumed: the place is found again in the map before any particle moves.

The law of an assumed motion is a Gaussian, which can wait: as long as the map says nothing about where the camera has come,
it grows with every pair, and no particle is drawn from it. Drawn at once, a few hundred particles would be decimetres
apart, none of them within millimetres of the right place, and landmarks started then would be so, too.
"""

from typing import TYPE_CHECKING

from rbpf.systems.stereo.dead_reckoning import Reckoned

if TYPE_CHECKING:
    from rbpf.systems.stereo.run import StereoRun


def waits(run: "StereoRun", t: int, at: Reckoned) -> bool:
    """Whether pair t is not to update the filter: the motion up to it was only assumed, and the map says nothing yet."""
    recovery = run.config.recovery
    if not (recovery.used and at.assumed):
        return False
    belief = run.filter.expect(at.since_update, int(run.stamps_ns[t]))
    count, after = run.front_end.recognised(belief), f"after {at.assumed} pairs whose motion was only assumed"
    if count >= run.config.map.agreeing:
        run.notes.append(f"pair {t}: the camera is found again by {count} landmarks of the map, {after}")
        return False
    if at.known >= recovery.patience:
        run.notes.append(f"pair {t}: the camera is not found again in the map, which goes on from here, {after}")
        return False
    return True
