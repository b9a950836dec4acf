"""What stands still is followed from pair to pair."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.systems.stereo.standing import Standing

NONE = np.zeros(0, dtype=np.intp)


def mask(*rows: int, of: int = 4) -> np.ndarray:
    return np.isin(np.arange(of), rows)


def started() -> Standing:
    """A pair of five features: two stand still, one moves."""
    standing = Standing()
    standing.note(3, np.zeros(0, dtype=bool), NONE)
    standing.look()
    standing.match(np.arange(3), np.array([4, 0, 2]))
    standing.leave_out(mask(2, of=3))
    standing.note(5, mask(0, 1, of=3), NONE)
    return standing


def test_labels_follow_the_matches():
    standing = started()
    standing.look()
    assert standing.before().size == 0
    standing.match(np.array([0, 2, 3, 4]), np.array([3, 2, 1, 0]))
    np.testing.assert_array_equal(standing.before(), [1, -1, 0, 1])


def test_where_no_motion_is_found_all_stay_what_they_were():
    standing = started()
    standing.look()
    standing.match(np.array([0, 2, 3, 4]), np.array([3, 2, 1, 0]))
    standing.leave_out(mask(3))
    standing.note(4, mask(), NONE)
    standing.look()
    standing.match(np.arange(4), np.arange(4))
    np.testing.assert_array_equal(standing.before(), [-1, 0, -1, 1])


def test_what_the_map_has_stands_still():
    standing = started()
    standing.look()
    standing.match(np.array([1, 2]), np.array([0, 1]))
    standing.leave_out(mask(0, 1, of=2))
    np.testing.assert_array_equal(standing.moving, [0, 1])
    standing.note(3, mask(of=2), np.array([1]))
    standing.look()
    standing.match(np.arange(3), np.arange(3))
    np.testing.assert_array_equal(standing.before(), [-1, 1, 0])


def test_state_is_kept():
    standing, other = started(), Standing()
    other.restore(standing.arrays(), 5)
    with pytest.raises(InputError, match="pair/stood"):
        other.restore(standing.arrays(), 4)
    for one in (standing, other):
        one.look()
        one.match(np.arange(5), np.arange(5))
    np.testing.assert_array_equal(standing.before(), other.before())
