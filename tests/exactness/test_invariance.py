"""The order of particles changes nothing but rounding."""

from typing import Any

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.models import NEW, NULL, NewLandmarks, Observations
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.exactness.models import Frame, Scripted
from tests.exactness.scenes import sensors

PARTICLES = 40
TOLERANCE = 1e-9
compiled_or_not = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "numpy"])


class Reordered(np.random.Generator):
    """Gives row i of each normal draw to the particle that stands at order[i] in the other run."""

    order: np.ndarray

    def standard_normal(self, size: Any = None, *args: Any, **kwargs: Any) -> Any:
        return super().standard_normal(size, *args, **kwargs)[self.order]


def generator(order: np.ndarray) -> Reordered:
    rng = Reordered(np.random.PCG64(21))
    rng.order = order
    return rng


@compiled_or_not
@pytest.mark.parametrize("proposal", [PriorProposal(), EkfProposal()], ids=["prior", "ekf"])
def test_the_order_of_particles_does_not_matter(proposal, compiled):
    """Each with its own start, noise and associations; the weights follow, the summaries stay."""
    rng = np.random.default_rng(12)
    order = rng.permutation(PARTICLES)
    start = rng.normal(scale=0.1, size=(PARTICLES, 3))
    landmarks, model = rng.normal(scale=4.0, size=(4, 2)) + 5.0, sensors(SE2, rng)[0]
    R, cov = np.tile(0.01 * np.eye(2), (4, 1, 1)), 0.01 * np.eye(3)
    z = model.predict(SE2.identity(), landmarks) + rng.normal(scale=0.1, size=(5, 4, 2))
    ids = np.where(rng.random((5, PARTICLES, 4)) < 0.8, np.arange(4), rng.choice([NEW, NULL], (5, PARTICLES, 4)))
    filters = []
    for place in (np.arange(PARTICLES), order):
        held = LandmarkMap(SE2, compiled=compiled)
        never, rng = EssTriggered(Systematic(), 0.0), generator(place)
        filter_ = Filter(OdometryMotion(SE2), Scripted(), held, proposal, never, PARTICLES, rng, start[place])
        frames = [Frame((), [NewLandmarks(z[0], R, model, Point(2))])]
        frames += [Frame([Observations(z[t], R, model, None, ids[t][place], -3.0, -4.0)]) for t in range(1, 5)]
        filters.append((filter_, [filter_.step(frame, Odometry(SE2.identity(), cov)) for frame in frames]))
    (one, reports), (other, others) = filters
    np.testing.assert_allclose(other.particles.state, one.particles.state[order], atol=TOLERANCE)
    np.testing.assert_allclose(other.particles.log_weights, one.particles.log_weights[order], atol=TOLERANCE)
    assert np.ptp(one.particles.log_weights) > 1.0
    for ours, theirs in zip(reports, others, strict=True):
        assert theirs.log_evidence == pytest.approx(ours.log_evidence, abs=TOLERANCE)
        assert theirs.ess == pytest.approx(ours.ess, rel=TOLERANCE)
        np.testing.assert_allclose(theirs.estimate.mean, ours.estimate.mean, atol=TOLERANCE)
        np.testing.assert_allclose(theirs.estimate.cov, ours.estimate.cov, atol=TOLERANCE)
