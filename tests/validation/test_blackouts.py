"""What counts as recovered, and where blackouts start."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.validation.blackout_runs import Dark, even_starts
from rbpf.validation.blackouts import Outcome, Series, pose_differences
from tests.systems.plane_sequences import sequence

RATE = 10.0
DARK = range(20, 30)
RIGHT = Outcome(DARK, 32, 20, np.full(40, 0.03), np.full(40, 1.0), np.nan, ())
"""Found in frame 32; judged in frame 42."""


@pytest.fixture
def series():
    """With usual errors of 2 cm and half a degree."""
    return Series("plane", RATE, 2.0, [RIGHT], np.zeros(1), np.full(100, 0.02), np.full(100, 0.5))


def test_verdicts(series):
    wrong = np.where(np.arange(40) == 42 - 19, 0.13, 0.0)
    cases = {
        "rightly": RIGHT,
        "late": replace(RIGHT, found=51),
        "not": replace(RIGHT, found=-1),
        "wrongly": replace(RIGHT, errors_m=wrong),
    }
    assert {name: series.verdict(one) for name, one in cases.items()} == {name: name for name in cases}
    assert series.verdict(replace(RIGHT, errors_deg=30.0 * wrong)) == "wrongly"
    assert series.verdict(replace(RIGHT, errors_m=0.9 * wrong)) == "rightly"


def test_the_pose_is_judged_when_it_has_settled(series):
    assert series.seconds(RIGHT) == pytest.approx(0.2)
    assert series.judged(RIGHT) == 42
    # Where the run ends before, in its last frame.
    short = replace(RIGHT, errors_m=np.full(15, 0.03), errors_deg=np.full(15, 1.0))
    assert series.judged(short) == 33
    assert series.seconds(replace(RIGHT, found=-1)) == np.inf


def test_starts_are_even_and_different():
    assert even_starts(30, 131, 11) == list(range(30, 131, 10))
    assert even_starts(30, 33, 50) == [30, 31, 32]
    assert even_starts(30, 10, 50) == [30]


def test_the_light_goes_out_and_on():
    images = [frame.image.max() for frame in Dark(sequence(10).source, range(3, 5), 7).frames(2)]
    assert [bool(level) for level in images] == [True, False, False, True, True]


def test_differences_of_poses():
    turn, shift = np.deg2rad(30.0), 0.4
    pose = SE3.exp([0.3, -0.2, 0.5, 1.0, 2.0, 3.0])
    moved = SE3.compose(
        SE3.exp([0.0, 0.0, 0.0, shift, 0.0, 0.0]), SE3.compose(pose, SE3.exp([0.0, turn, 0.0, 0, 0, 0]))
    )
    metres, degrees = pose_differences(moved[None], pose[None])
    assert (metres[0], degrees[0]) == pytest.approx((shift, 30.0))
