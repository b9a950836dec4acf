"""Which landmark a feature is: what is expected where, and whether matches that are expected vaguely agree."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.models import NULL
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.sensors.stereo import StereoFeatures
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.learnt_noise import LearntNoise
from rbpf.systems.stereo.config import MapConfig, StereoConfig, TriggerConfig
from rbpf.systems.stereo.landmarks import Pair, log_support
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.stereo.tracks import tracked_features
from rbpf.systems.system import MAP_IDS
from tests.systems.stereo_sequences import half_exchanged, pairs

pytestmark = pytest.mark.usefixtures("keypoints_once")
COUNT = 10
CONFIG = replace(
    StereoConfig.s05(),
    particles=60,
    trigger=TriggerConfig(0.0, 0.0),
    likelihood=replace(StereoConfig().likelihood, kind="outliers"),
    proposal=ProposalConfig("ekf", iterations=3),
)
WIDE = Odometry(SE3.identity(), np.diag(np.repeat([0.1**2, 0.2**2], 3)))
FEW = CONFIG.map.min_agreeing - 1


@pytest.fixture
def slam(keypoints_once: None) -> StereoSlam:
    """After the last pair."""
    sequence = pairs(COUNT)
    slam = StereoSlam(sequence.rig, CONFIG)
    for frame in sequence.frames():
        slam.take(frame)
    return slam


def view(features: StereoFeatures) -> Pair[StereoFeatures]:
    everything = np.ones(len(features), dtype=bool)
    return Pair(COUNT * 10**9, features, everything, everything, np.zeros(len(features), dtype=np.int8))


def few(slam: StereoSlam) -> StereoFeatures:
    """Of the last pair, one fewer than must agree, all of landmarks."""
    return slam._kept.features.take(np.flatnonzero(slam.front_end.landmarks.ids >= 0)[:FEW])


def test_false_matches_do_not_agree(slam):
    """Half of the places are wrong: those that are taken are right, and the camera is found."""
    landmarks, exchanged = slam.front_end.landmarks, half_exchanged(slam.rig, slam._kept.features)
    before, known = slam.at_update.mean, landmarks.manager.next_name
    right = np.abs(exchanged.z - slam._kept.features.z).max(axis=1) == 0.0
    slam.filter.step(view(exchanged), WIDE)
    taken = (landmarks.ids >= 0) & (landmarks.ids < known)
    assert taken.sum() > FEW and right[taken].mean() > 0.9
    off = SE3.local(before, slam.filter.estimate().mean)
    assert np.linalg.norm(off[:3]) < 0.01 and np.linalg.norm(off[3:]) < 0.02


def test_too_few_are_not_taken_where_they_are_expected_vaguely(slam):
    assert slam.filter.step(view(few(slam)), WIDE).groups == []
    assert np.sqrt(np.diagonal(slam.filter.estimate().cov)[3:]).min() > 0.1


def test_else_few_are_enough(slam):
    """The gate tells true from false."""
    report = slam.filter.step(view(few(slam)), Odometry(SE3.identity(), 1e-6 * np.eye(6)))
    assert sum((group.ids >= 0).sum() for group in report.groups) >= 3


def test_how_well_landmarks_are_seen():
    """Beside the formula for one of them; a far one says nothing, and never speaks against."""
    rig = pairs(2).rig
    z = np.array([[10.0, 20.0, 5.0], [100.0, 90.0, 65.0], [50.0, 60.0, 44.0], [300.0, 200.0, 290.0]])
    density = 4.0 / (320.0 * 240.0 * 30.0)
    nu, cov = np.array([[1.0, 0.0, 0.0], [90.0, 0.0, 0.0]]), np.tile(4.0 * np.eye(3), (2, 1, 1))
    log_normal = -0.5 * (0.25 + 3.0 * np.log(2.0 * np.pi * 4.0))
    assert log_support(nu, cov, z, rig) == pytest.approx(log_normal - np.log(density))


def test_noise_of_each_landmark_is_learnt_from_its_residuals():
    """Of some it is three times, of others half as large as their scale says; a new one has the mean."""
    rng, noise, ids = np.random.default_rng(0), LearntNoise(), np.arange(0, 80, 2)
    deviation = np.where(ids % 4 == 0, 3.0, 0.5)
    cov = np.repeat(0.1 * np.eye(3)[None], ids.size, axis=0)
    for _ in range(400):
        error = deviation[:, None] * np.sqrt(0.1) * rng.normal(size=(ids.size, 3)) * np.sqrt(0.9)
        noise.learn(ids, error, 0.1 * deviation[:, None, None] ** 2 * cov, noise.factor(ids)[:, None, None] * cov)
    np.testing.assert_allclose(np.sqrt(noise.factor(ids)), deviation, rtol=0.1)
    assert noise.factor(np.array([3]))[0] == pytest.approx(0.5 * (9.0 + 0.25), rel=0.1)
    again = LearntNoise()
    again.restore(noise.arrays() | {MAP_IDS: ids})
    noise.remove(ids[:1])
    assert noise.factor(ids[:2])[0] == noise.factor(np.array([3]))[0] != again.factor(ids[:1])[0]


@pytest.mark.parametrize(
    ("deviation", "right", "found"), [(2.0, 1.2, 2.0), (1.05, 1.2, 1.0), (0.5, 1.2, 1.0), (0.5, 0.0, 0.5)]
)
def test_noise_of_all_landmarks_is_learnt_together(deviation, right, found):
    """A first guess does not hold it; what is stated is right up to a limit, but for what slides; a checkpoint keeps it."""
    rng, noise, ids = np.random.default_rng(0), LearntNoise(shared=True, right=right), np.arange(20)
    cov, times = np.repeat(0.1 * np.eye(2)[None], ids.size, axis=0), np.where(ids == 7, 10.0, 1.0)
    noise.expect(4.0)
    for _ in range(800):
        error = deviation * times[:, None] * np.sqrt(0.1) * rng.normal(size=(ids.size, 2)) * np.sqrt(0.9)
        had = noise.factor(ids)[:, None, None] * cov
        noise.learn(ids, error, 0.1 * had, had)
    factors = np.sqrt(noise.factor(np.array([3, 77, 7])))
    np.testing.assert_allclose(factors, np.array([1.0, 1.0, 5.0]) * found, rtol=0.06)
    again = LearntNoise(shared=True, right=right)
    again.restore(noise.arrays() | {MAP_IDS: ids})
    assert again.mean == noise.mean


def test_what_was_put_away_is_held_again_when_it_is_seen():
    """By what it looks like, and where: all of it from near, or as if it were from afar, where it has to agree on a motion."""
    for far in (False, True):
        sequence, held = pairs(16), []
        slam = StereoSlam(sequence.rig, replace(CONFIG, map=MapConfig(kind="joint")))
        landmarks = slam.front_end.landmarks
        for t, frame in enumerate(sequence.frames()):
            if t == COUNT:
                gone = landmarks.manager.names[landmarks.manager.confirmed]
                slam.joint.put_away(gone)
                slam.filter.consolidate()
                assert gone.size > 30 and not slam.joint.holds(gone).any()
                if far:
                    old = slam.joint.old
                    old.about = old.about.of(np.flatnonzero(slam.joint.holds(old.about.ids)))
            told = slam.take(frame)
            held.append(slam.joint.holds(gone).mean() if t >= COUNT else 1.0)
        assert held[-1] > 0.5 and np.isin(gone, slam.map().ids).all()
        assert np.isin(gone, landmarks.ids).mean() > 0.3
        off = SE3.between(SE3.between(sequence.truth.poses[0], sequence.truth.poses[-1]), told.pose)
        assert np.linalg.norm(SE3.translation(off)) < 0.02


def test_landmarks_that_are_confirmed_make_room_for_candidates_at_once():
    sequence = pairs(8)
    few = replace(CONFIG.new_landmarks, max_candidates=10)
    slam = StereoSlam(sequence.rig, replace(CONFIG, map=MapConfig(kind="joint"), new_landmarks=few))
    for frame in sequence.frames():
        slam.take(frame)
        assert (~slam.front_end.landmarks.manager.confirmed).sum() == 10


def test_a_pixel_tells_the_motion_or_the_map(monkeypatch):
    """What no landmark has used is followed to the next update, and makes the motion better known; nothing is used twice."""
    sequence, covs = pairs(8), []
    for _ in range(2):
        slam = StereoSlam(sequence.rig, replace(CONFIG, map=MapConfig(kind="joint")))
        for t, frame in enumerate(sequence.frames()):
            told, followed = slam.take(frame), slam.reckoning.left_over.any(axis=(1, 2))
            assert t < 2 or (followed.sum() > 20 and not followed[slam.front_end.landmarks.ids != NULL].any())
        covs.append(told.cov[3:, 3:])
        monkeypatch.setattr(StereoSlam, "_joined", lambda self, prior, *others: prior)
    assert np.trace(covs[0]) < 0.95 * np.trace(covs[1])


# Tracks: what odometry and map say is one point, told once for each pair that shows it.

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
    ("pairs", "told"),
    [
        (  # odometry alone makes tracks; single sightings are left out
            [((1, 2, 3), (NO, NO, NO)), ((11, 12), (NO, NO), [(2, 0)]), ((21, 22), (NO, NO), [(0, 1), (1, 0)]), None],
            ({(3, 11, 22, None), (None, 12, 21, None)}, {}),
        ),
        (  # the map closes gaps and gives its names
            [((1,), (7,)), ((), ()), None, ((31, 32), (NO, 7))],
            ({(1, None, None, 32)}, {7: 1}),
        ),
        (  # lost for a pair, followed anew, and named a pair later: all of it is one track
            [((1,), (7,)), ((11,), (NO,)), ((21,), (7,), [(0, 0)]), None],
            ({(1, 11, 21, None)}, {7: 1}),
        ),
        (  # odometry and map disagree which of two features the point is: neither takes the other's place
            [((1, 2), (7, NO)), ((11, 12), (NO, 7), [(0, 0), (1, 1)]), ((21, 22), (NO, NO), [(0, 0), (1, 1)]), None],
            ({(1, 11, 21, None), (2, 12, 22, None)}, {7: 1}),
        ),
        (  # names of the map and of other tracks do not meet
            [((1, 2, 3), (0, NO, 1)), ((11, 12, 13), (0, NO, 1), [(0, 0), (1, 1), (2, 2)]), None, None],
            ({(1, 11, None, None), (2, 12, None, None), (3, 13, None, None)}, {0: 1, 1: 3}),
        ),
        (  # a pair that was not measured is passed over
            [((1,), (NO,)), None, ((21,), (NO,), [(0, 0)]), None],
            ({(1, None, 21, None)}, {}),
        ),
        ([None] * 4, (set(), {})),
    ],
)
def test_tracks(pairs, told):
    """Told are the columns of all tracks, and the first one of those whose names are known."""
    found, (expected, named) = tracks(pairs), told
    assert set(found.values()) == expected and len(found) == len(expected)
    assert {name: found[name][0] for name in named} == named
