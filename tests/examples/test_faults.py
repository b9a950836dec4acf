"""Faults of cameras: each does what it says, to both kinds of sequences, from wherever they are read."""

import numpy as np
import pytest

from examples.studies.fault_matrix import try_stereo, usual_faults
from examples.studies.image_faults import black_out, blur_motion, keep_every
from examples.studies.mono_blackouts import Dark
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


def test_the_light_goes_out_and_on():
    images = [frame.image.max() for frame in Dark(sequence(10).source, range(3, 5), 7).frames(2)]
    assert [bool(level) for level in images] == [True, False, False, True, True]
