"""Faults of cameras: each does what it says, to both kinds of sequences, from wherever they are read."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.fault_matrix import try_stereo, usual_faults
from examples.studies.image_faults import (
    black_out,
    blur_motion,
    drop_frames,
    keep_every,
    salt_and_pepper,
    truncate_files,
)
from examples.studies.mono_blackouts import Dark, Outcome, Series
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.stereo.config import StereoConfig
from tests.systems.plane_sequences import sequence
from tests.systems.stereo_sequences import pairs

FRAMES = 12
FAULTS = usual_faults(4.0, FRAMES) | {"slower": keep_every(3)}


def images(of) -> list[np.ndarray | None]:
    return [frame.image for frame in of.frames()]


@pytest.fixture(scope="module")
def whole() -> ImageSequence:
    return sequence(FRAMES)


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_the_same_bytes_from_wherever_it_is_read(whole, name):
    """The stamps are those of the sequence, and a run that is resumed sees what it would have seen."""
    damaged = FAULTS[name](whole)
    all_of_it = list(damaged.frames())
    assert [frame.stamp_ns for frame in all_of_it] == damaged.stamps_ns.tolist()
    assert len(all_of_it) == len(damaged)
    later = list(damaged.frames(2))
    for one, other in zip(all_of_it[2:], later, strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_array_equal(all_of_it[0].image, images(whole)[0])


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_pairs_are_damaged_in_both_images(name):
    both = pairs(4)
    damaged = FAULTS[name](both)
    for frame in damaged.frames():
        assert (frame.image is None) == (frame.right is None)
    assert damaged.rig.camera == damaged.camera
    assert damaged.truth is both.truth


def test_shares(whole):
    long = sequence(400)
    assert len(drop_frames(0.3)(long)) == pytest.approx(280, abs=40)
    unread = [frame.problem is not None for frame in truncate_files(0.3)(sequence(60)).frames()]
    assert 8 <= sum(unread) <= 28 and not unread[0]
    struck = salt_and_pepper(0.1)(whole)
    before, after = images(whole)[3], images(struck)[3]
    changed = (before != after).mean()
    assert changed == pytest.approx(0.1, abs=0.02)
    assert set(np.unique(after[before != after])) <= {0, 255}


def test_darkness_is_where_it_is_said(whole):
    dark = [image.max() == 0 for image in images(black_out(3, 4)(whole))]
    assert dark == [3 <= t < 7 for t in range(FRAMES)]


def test_blur_is_the_mean_along_a_line(whole):
    """The direction of image 0 would be along the rows; that of others turns. A point becomes a line of its length."""
    image = np.zeros((41, 41), np.uint8)
    image[20, 20] = 255
    painted = blur_motion(9)(sequence(3, lambda t, _: image))
    after = images(painted)[2].astype(float)
    assert after.sum() == pytest.approx(255.0, abs=9.0)
    rows, columns = np.nonzero(after)
    assert np.hypot(np.ptp(rows), np.ptp(columns)) == pytest.approx(8.0, abs=1.5)


@pytest.mark.slow
def test_verdicts_on_pairs():
    """A dark half second is recovered from; everything dark from the third pair on is not, and is said."""
    faults = {"short": black_out(8, 4), "for good": black_out(3, 100), "slower": keep_every(2)}
    clean, short, for_good, slower = try_stereo(pairs(24), StereoConfig(particles=50), faults)
    assert clean.verdict == "as without" and clean.lost == 0 and clean.said == ""
    assert short.verdict == "recovers" and short.lost == 4 and "passed over" in short.said
    assert for_good.verdict == "lost" and for_good.lost == 21
    assert slower.frames == 12 and slower.verdict == "as without"


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


def test_the_light_goes_out_and_on():
    images = [frame.image.max() for frame in Dark(sequence(10).source, range(3, 5), 7).frames(2)]
    assert [bool(level) for level in images] == [True, False, False, True, True]
