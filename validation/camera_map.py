"""The map of a camera filter in the world of its known points, one Gaussian per landmark."""

import numpy as np

from rbpf import gaussian
from rbpf.core.filter import Filter
from rbpf.lie import SE3
from rbpf.maps.point import Point
from rbpf.sensors.range_bearing import RelativePosition
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.slam import world_of


def summarise_points(filter_: Filter) -> MapEstimate:
    """Mixture moments of all point landmarks, the uncertainty of the known points' frame included.

    Landmarks whose depth is not known yet have no position and are left out. Without a frame of known points the world
    is the particles' own.

    Args:
        filter_: of `rbpf.systems.mono`.
    """
    belief, world = filter_.belief(), world_of(filter_)
    ids = belief.map.ids
    ids = ids[belief.map.are(ids, Point(3))]
    records = belief.read(ids)
    points, within = records.mean, records.cov
    if world is not None:
        model, anchor = RelativePosition(SE3), world.mean[:, None]
        slopes = model.jacobians(anchor, records.mean)
        assert slopes.state is not None and slopes.landmark is not None
        moved = slopes.state @ world.factor[:, None]
        points = model.predict(anchor, records.mean)
        within = slopes.landmark @ within @ np.swapaxes(slopes.landmark, -1, -2)
        within = within + moved @ np.swapaxes(moved, -1, -2)
    mean = np.einsum("n,nkd->kd", belief.weights, points)
    between = np.einsum("n,nkd,nke->kde", belief.weights, points - mean, points - mean)
    cov = np.einsum("n,nkde->kde", belief.weights, within) + between
    return MapEstimate(ids, mean, gaussian.symmetrise(cov))
