"""What stands still is followed from pair to pair."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.systems.stereo.motion_segmentation import MotionSegmentation

NONE = np.zeros(0, dtype=np.intp)


def mask(*rows: int, of: int = 4) -> np.ndarray:
    return np.isin(np.arange(of), rows)


def started() -> MotionSegmentation:
    """A pair of five features: two stand still, one moves."""
    segmentation = MotionSegmentation()
    segmentation.note(3, np.zeros(0, dtype=bool), NONE)
    segmentation.look()
    segmentation.match(np.arange(3), np.array([4, 0, 2]))
    segmentation.leave_out(mask(2, of=3))
    segmentation.note(5, mask(0, 1, of=3), NONE)
    return segmentation


def test_labels_follow_the_matches():
    segmentation = started()
    segmentation.look()
    assert segmentation.before().size == 0
    segmentation.match(np.array([0, 2, 3, 4]), np.array([3, 2, 1, 0]))
    np.testing.assert_array_equal(segmentation.before(), [1, -1, 0, 1])


def test_where_no_motion_is_found_all_stay_what_they_were():
    segmentation = started()
    segmentation.look()
    segmentation.match(np.array([0, 2, 3, 4]), np.array([3, 2, 1, 0]))
    segmentation.leave_out(mask(3))
    segmentation.note(4, mask(), NONE)
    segmentation.look()
    segmentation.match(np.arange(4), np.arange(4))
    np.testing.assert_array_equal(segmentation.before(), [-1, 0, -1, 1])


def test_what_the_map_has_stands_still():
    segmentation = started()
    segmentation.look()
    segmentation.match(np.array([1, 2]), np.array([0, 1]))
    segmentation.leave_out(mask(0, 1, of=2))
    np.testing.assert_array_equal(segmentation.moving, [0, 1])
    segmentation.note(3, mask(of=2), np.array([1]))
    segmentation.look()
    segmentation.match(np.arange(3), np.arange(3))
    np.testing.assert_array_equal(segmentation.before(), [-1, 1, 0])


def test_state_is_kept():
    segmentation, other = started(), MotionSegmentation()
    other.restore(segmentation.arrays(), 5)
    with pytest.raises(InputError, match="pair/stood"):
        other.restore(segmentation.arrays(), 4)
    for one in (segmentation, other):
        one.look()
        one.match(np.arange(5), np.arange(5))
    np.testing.assert_array_equal(segmentation.before(), other.before())
