"""Tracks: what odometry and map say is one point, told once for each pair that shows it."""

import numpy as np
import pytest

from rbpf.core.models import NULL
from rbpf.systems.stereo.tracks import tracked_features

STAMPS = np.array([10, 20, 30, 40])
NO = NULL


def noted(columns, names, matches=()):
    """What a system says of one pair: where its features are, of which landmarks, and of which features before."""
    u = np.array(columns, dtype=float)
    previous = np.full(u.size, NULL)
    for before, now in matches:
        previous[now] = before
    z = np.stack([u, np.full(u.size, 5.0), u - 3.0], axis=1)
    cov = np.eye(3) * (1.0 + u)[:, None, None]
    return {"z": z, "cov_z": cov, "previous": previous, "landmarks": np.array(names, dtype=np.int64)}


def tracks(pairs) -> dict[int, tuple[float | None, ...]]:
    """Columns of each track in the four pairs, by its name; a pair that is `None` was not measured."""
    shown = [noted([], []) if pair is None else noted(*pair) for pair in pairs]
    frames = tracked_features(STAMPS, np.array([pair is not None for pair in pairs]), shown)
    seen = [dict(zip(f.landmarks.tolist(), f.z[:, 0].tolist(), strict=True)) for f in frames]
    for frame in frames:
        np.testing.assert_array_equal(frame.cov_z[:, 0, 0], 1.0 + frame.z[:, 0])
    return {name: tuple(frame.get(name) for frame in seen) for name in set().union(*seen)}


@pytest.mark.parametrize(
    ("pairs", "expected", "named"),
    [
        (  # odometry alone makes tracks; single sightings are left out
            [((1, 2, 3), (NO, NO, NO)), ((11, 12), (NO, NO), [(2, 0)]), ((21, 22), (NO, NO), [(0, 1), (1, 0)]), None],
            {(3, 11, 22, None), (None, 12, 21, None)},
            {},
        ),
        (  # the map closes gaps and gives its names
            [((1,), (7,)), ((), ()), None, ((31, 32), (NO, 7))],
            {(1, None, None, 32)},
            {7: 1},
        ),
        (  # lost for a pair, followed anew, and named a pair later: all of it is one track
            [((1,), (7,)), ((11,), (NO,)), ((21,), (7,), [(0, 0)]), None],
            {(1, 11, 21, None)},
            {7: 1},
        ),
        (  # odometry and map disagree which of two features the point is: neither takes the other's place
            [((1, 2), (7, NO)), ((11, 12), (NO, 7), [(0, 0), (1, 1)]), ((21, 22), (NO, NO), [(0, 0), (1, 1)]), None],
            {(1, 11, 21, None), (2, 12, 22, None)},
            {7: 1},
        ),
        (  # names of the map and of other tracks do not meet
            [((1, 2, 3), (0, NO, 1)), ((11, 12, 13), (0, NO, 1), [(0, 0), (1, 1), (2, 2)]), None, None],
            {(1, 11, None, None), (2, 12, None, None), (3, 13, None, None)},
            {0: 1, 1: 3},
        ),
        (  # a pair that was not measured is passed over
            [((1,), (NO,)), None, ((21,), (NO,), [(0, 0)]), None],
            {(1, None, 21, None)},
            {},
        ),
        ([None] * 4, set(), {}),
    ],
)
def test_tracks(pairs, expected, named):
    """`named`: the first column of tracks whose names are known."""
    found = tracks(pairs)
    assert set(found.values()) == expected and len(found) == len(expected)
    assert {name: found[name][0] for name in named} == named
