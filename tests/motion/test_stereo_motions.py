"""Of several motions the camera's: each thing that is known has its say, and no more than its say."""

from itertools import product

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_motions import CHANGES, MISTAKEN, Known, camera_motion
from rbpf.motion.stereo_odometer import StereoOdometer
from tests.motion.stereo_pairs import HAND, LEAP, ROOM, joined, simulate

EXPECTED = Odometry(SE3.identity(), np.diag(np.repeat(0.1**2, 6)))


def law(*xi: float) -> Odometry:
    return Odometry(SE3.exp(np.array(xi)), 1e-6 * np.eye(6))


STILL, AWAY = law(0, 0, 0, 0, 0, 0), law(0, 0, 0, 0.3, 0, 0)


def groups(*counts: int, left: int = 5) -> np.ndarray:
    """Disjoint groups of so many matches, and some that are in none."""
    out, first = np.zeros((len(counts), sum(counts) + left), dtype=bool), 0
    for row, count in enumerate(counts):
        out[row, first : first + count] = True
        first += count
    return out


def chosen(masks: np.ndarray, known: Known | None = None, trusted: bool = False) -> int:
    return camera_motion(masks, [STILL, AWAY], known or Known(), EXPECTED, trusted)


def test_the_many_where_nothing_is_known():
    assert chosen(groups(20, 30)) == 1
    assert chosen(groups(30, 20)) == 0


def test_a_velocity_that_was_measured():
    """Three standard deviations are exp(4.5) = 90 to one; a group of twice as many does not make up for it."""
    assert chosen(groups(20, 40), trusted=True) == 0
    assert chosen(groups(20, 40), trusted=False) == 1
    assert chosen(groups(2, 400), trusted=True) == 1


def test_the_map_decides():
    def of_map(increment: Odometry) -> float:
        return 40.0 * bool(np.allclose(increment.delta, STILL.delta) and increment is not EXPECTED)

    assert chosen(groups(10, 200), Known(of_map)) == 0


def test_none_of_them_is_believed_of_the_map_alone():
    """Landmarks that no motion explains, and a wide law does: as likely as one match more, whatever was expected."""
    for support, right in ((np.log(201) + 0.1, -1), (np.log(201) - 0.1, 1)):

        def of_map(increment: Odometry, support: float = support) -> float:
            return support * (increment is EXPECTED)

        assert chosen(groups(10, 200), Known(of_map)) == right
    assert chosen(groups(10, 2), Known(), trusted=True) >= 0


@pytest.mark.parametrize("marks", list(product([-1, 0, 1], repeat=3)))
def test_the_past_against_enumeration(marks):
    """P(marks | stands still) / P(marks | moves), summed over whether the thing has changed since the pair before."""
    group = np.ones(3, dtype=bool)
    known = Known(stood=np.array(marks, dtype=np.int8))

    def likelihood(stood: bool) -> float:
        right = [1.0 - MISTAKEN if (mark > 0) == stood else MISTAKEN for mark in marks if mark]
        return float(np.prod(right))

    still, moved = likelihood(True), likelihood(False)
    ratio = ((1 - CHANGES) * still + CHANGES * moved) / ((1 - CHANGES) * moved + CHANGES * still)
    assert known.log_past(group) == pytest.approx(np.log(ratio))


def test_the_past_is_no_proof():
    """A thing of 1,000 features that has stopped: bounded by how often things stop."""
    known = Known(stood=-np.ones(1000, dtype=np.int8))
    assert known.log_past(np.ones(1000, dtype=bool)) == pytest.approx(np.log(CHANGES / (1 - CHANGES)))
    assert Known().log_past(np.ones(3, dtype=bool)) == 0.0


def test_when_a_single_motion_is_doubted():
    agree = np.array([1, 1, 1, 1, 0, 0, 0], dtype=bool)
    assert not Known().contradicts(agree)
    assert not Known(stood=np.array([1, 1, 1, 0, 1, 0, 0])).contradicts(agree)
    assert Known(stood=np.array([1, 0, 0, 0, 1, 1, 0])).contradicts(agree)
    assert Known(stood=np.array([-1, -1, 0, 0, 0, 0, 0])).contradicts(agree)
    assert Known(stood=np.zeros(7), hidden=True).contradicts(agree)


def step(known: Known | None, seed: int = 0):
    """A room of 20 matches and a thing of 60 that has leapt."""
    rng = np.random.default_rng(seed)
    room, thing = simulate(ROOM, 20, rng), simulate(LEAP, 60, rng)
    both = joined(room.matches, thing.matches)
    odometer = StereoOdometer(HAND, np.random.default_rng(1))
    found = odometer.step(both.z_prev, both.z_now, both.cov_prev, both.cov_now, 0.1, known)
    return found, room, thing


def off(found, pair) -> float:
    return float(np.linalg.norm(SE3.local(found.odometry.delta, pair.delta)))


@pytest.mark.parametrize("seed", range(3))
def test_the_few_that_stood_still_before(seed):
    found, _, thing = step(None, seed)
    assert off(found, thing) < 0.02 and not found.moving[20:].any()
    stood = np.concatenate([np.ones(20), -np.ones(60)]).astype(np.int8)
    found, room, _ = step(Known(stood=stood), seed)
    assert off(found, room) < 0.02
    assert found.moving[20:].mean() > 0.8 and not found.moving[:20].any()
    assert "something in the view moves" in found.note and "that of the" in found.note


def test_what_the_map_contradicts_is_not_believed():
    """A thing alone is in view that moved before; nothing says that it has stopped."""
    rng = np.random.default_rng(0)
    thing = simulate(LEAP, 12, rng).matches
    odometer = StereoOdometer(HAND, np.random.default_rng(1))
    arrays = thing.z_prev, thing.z_now, thing.cov_prev, thing.cov_now, 0.1
    known = Known(lambda increment: 0.0, -np.ones(12, dtype=np.int8))
    found = odometer.step(*arrays, known)
    assert (
        not found.estimate.found
        and "but not the map and what stood still before; a camera at rest is assumed" in found.note
    )
    assert found.moving.sum() >= 10 and not odometer.velocity.any()
    np.testing.assert_array_equal(found.odometry.delta, SE3.identity())
    assert odometer.step(*arrays).estimate.found
