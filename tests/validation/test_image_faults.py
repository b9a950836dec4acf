"""Faults of cameras: each does what it says, to both kinds of sequences, from wherever they are read."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers.images import ImageSequence
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.fault_matrix import summarised, try_mono, try_stereo, usual_faults
from rbpf.validation.image_faults import (
    black_out,
    blur_motion,
    cover_view,
    drop_frames,
    jitter_stamps,
    jump_exposure,
    keep_every,
    salt_and_pepper,
    truncate_files,
    wrong_focal,
)
from tests.systems.plane_sequences import known_points, sequence
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
    assert damaged.rig.camera == damaged.pair.camera
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


def test_exposure_scales_the_grey_levels(whole):
    before, after = images(whole), images(jump_exposure(4, 0.5, 0.5001)(whole))
    np.testing.assert_array_equal(after[3], before[3])
    np.testing.assert_allclose(after[5], 0.5 * before[5].astype(float), atol=0.6)


def test_blur_is_the_mean_along_a_line(whole):
    """The direction of image 0 would be along the rows; that of others turns. A point becomes a line of its length."""
    image = np.zeros((41, 41), np.uint8)
    image[20, 20] = 255
    painted = blur_motion(9)(sequence(3, lambda t, _: image))
    after = images(painted)[2].astype(float)
    assert after.sum() == pytest.approx(255.0, abs=9.0)
    rows, columns = np.nonzero(after)
    assert np.hypot(np.ptp(rows), np.ptp(columns)) == pytest.approx(8.0, abs=1.5)


def test_something_passes_through_the_view(whole):
    before, after = images(whole), images(cover_view(1 / 3, 2, 8)(whole))
    fraction = [(a != b).mean() for a, b in zip(before, after, strict=True)]
    assert fraction[1] == 0.0 and fraction[10] == 0.0
    assert max(fraction) == pytest.approx(1 / 3, abs=0.02)
    middle = [
        np.flatnonzero((a != b).any(axis=0)).mean() for a, b in zip(before[2:10], after[2:10], strict=True)
    ]
    assert (np.diff(middle) > 0.0).all()


def test_the_calibration_is_wrong_and_the_images_are_right(whole):
    damaged = wrong_focal(1.1)(whole)
    assert damaged.camera.fx == pytest.approx(1.1 * whole.camera.fx)
    np.testing.assert_array_equal(images(damaged)[4], images(whole)[4])


def test_stamps_stay_in_order(whole):
    damaged = jitter_stamps(0.03)(whole)
    assert (np.diff(damaged.stamps_ns) >= 0).all() and damaged.stamps_ns[0] == whole.stamps_ns[0]
    assert np.abs(damaged.stamps_ns - whole.stamps_ns).max() > 1e7


def test_what_is_no_sequence_is_refused():
    with pytest.raises(InputError, match="has no ground truth"):
        try_mono(sequence(3), known_points(), MonoConfig(particles=4), {})


def test_the_same_sentence_is_told_once():
    said = ["frame 3: it is dark", "frame 4: it is dark", "pair 7 of lab: cut", "frame 9: found again"]
    assert summarised(said) == ["it is dark (x2)", "cut", "found again"]


@pytest.mark.slow
def test_verdicts_on_pairs():
    """A dark half second is recovered from; everything dark from the third pair on is not, and is said."""
    faults = {"short": black_out(8, 4), "for good": black_out(3, 100), "slower": keep_every(2)}
    clean, short, for_good, slower = try_stereo(pairs(24), StereoConfig(particles=50), faults)
    assert clean.verdict == "as without" and clean.lost == 0 and clean.said == ""
    assert short.verdict == "recovers" and short.lost == 4 and "passed over" in short.said
    assert for_good.verdict == "lost" and for_good.lost == 21
    assert slower.frames == 12 and slower.verdict == "as without"
