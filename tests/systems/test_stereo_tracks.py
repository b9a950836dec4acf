"""Tracks: what odometry and map say is one point, told once for each pair that shows it."""

import numpy as np

from rbpf.core.models import NULL
from rbpf.systems.stereo.tracks import tracked_features

NONE = np.zeros((2, 0), dtype=np.intp)
STAMPS = np.array([10, 20, 30, 40])


class Tracks:
    """What a system says of four pairs, those that are not noted not measured."""

    def __init__(self) -> None:
        nothing = {"z": np.zeros((0, 3)), "cov_z": np.zeros((0, 3, 3))}
        self.shown = [nothing | {"previous": names(), "landmarks": names()} for _ in STAMPS]
        self.measured = np.zeros(STAMPS.size, dtype=bool)

    def note(self, step, z, cov, matches, landmarks) -> None:
        previous = np.full(len(z), NULL)
        previous[matches[1]] = matches[0]
        self.shown[step] = {"z": z, "cov_z": cov, "previous": previous, "landmarks": landmarks}
        self.measured[step] = True

    def frames(self):
        return tracked_features(STAMPS, self.measured, self.shown)


def px(*columns: float) -> tuple[np.ndarray, np.ndarray]:
    """Features at these columns, with a covariance of their own."""
    u = np.array(columns, dtype=float)
    z = np.stack([u, np.full(u.size, 5.0), u - 3.0], axis=1)
    return z, np.eye(3) * (1.0 + u)[:, None, None]


def names(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def seen(tracks: Tracks) -> list[dict[int, float]]:
    """Column of each track in each pair."""
    return [dict(zip(f.landmarks.tolist(), f.z[:, 0].tolist(), strict=True)) for f in tracks.frames()]


def matched(*rows: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.array(rows, dtype=np.intp).reshape(-1, 2).T)  # type: ignore[return-value]


def test_odometry_alone_makes_tracks_and_single_sightings_are_left_out():
    tracks = Tracks()
    tracks.note(0, *px(1, 2, 3), NONE, names(NULL, NULL, NULL))
    tracks.note(1, *px(11, 12), matched((2, 0)), names(NULL, NULL))
    tracks.note(2, *px(21, 22), matched((0, 1), (1, 0)), names(NULL, NULL))
    first, second, third, fourth = seen(tracks)
    assert sorted(first.values()) == [3.0] and fourth == {}
    (name,) = first
    assert second[name] == 11.0 and third[name] == 22.0
    other = (set(second) - {name}).pop()
    assert (second[other], third[other]) == (12.0, 21.0)
    frame = tracks.frames()[0]
    np.testing.assert_array_equal(frame.cov_z[0], 4.0 * np.eye(3))
    assert frame.stamp_ns == 10


def test_the_map_closes_gaps_and_gives_its_names():
    tracks = Tracks()
    tracks.note(0, *px(1), NONE, names(7))
    tracks.note(1, *px(), NONE, names())
    tracks.note(3, *px(31, 32), NONE, names(NULL, 7))
    assert seen(tracks) == [{7: 1.0}, {}, {}, {7: 32.0}]


def test_a_track_that_the_map_knows_again_is_joined():
    """The point is lost for a pair, followed anew, and named a pair later: all of it is one track."""
    tracks = Tracks()
    tracks.note(0, *px(1), NONE, names(7))
    tracks.note(1, *px(11), NONE, names(NULL))
    tracks.note(2, *px(21), matched((0, 0)), names(7))
    assert seen(tracks)[:3] == [{7: 1.0}, {7: 11.0}, {7: 21.0}]


def test_what_one_pair_shows_twice_is_not_joined():
    """Odometry and map disagree about which of two features the point is: neither takes the other's place."""
    tracks = Tracks()
    tracks.note(0, *px(1, 2), NONE, names(7, NULL))
    tracks.note(1, *px(11, 12), matched((0, 0), (1, 1)), names(NULL, 7))
    tracks.note(2, *px(21, 22), matched((0, 0), (1, 1)), names(NULL, NULL))
    found = seen(tracks)
    assert [sorted(frame.values()) for frame in found[:3]] == [[1.0, 2.0], [11.0, 12.0], [21.0, 22.0]]
    assert [frame[7] for frame in found[:3]] == [1.0, 11.0, 21.0]


def test_a_pair_that_was_not_measured_is_passed_over():
    tracks = Tracks()
    tracks.note(0, *px(1), NONE, names(NULL))
    tracks.note(1, *px(9), NONE, names(NULL))
    tracks.note(2, *px(21), matched((0, 0)), names(NULL))
    tracks.measured[1] = False
    assert [sorted(frame.values()) for frame in seen(tracks)] == [[1.0], [], [21.0], []]
