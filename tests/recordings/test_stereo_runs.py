"""Stereo SLAM on recordings, beside its own odometry."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.stereo_revisit import pairs_there_and_back
from examples.studies.stereo_revisit import scores as scores_of
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_opened, open_pairs
from rbpf.runs.run import Run
from rbpf.sensors.descriptors import MatchLimits, gate_pairs, match_all, match_pairs
from rbpf.sensors.features import Sift
from rbpf.sensors.readers import open_stereo
from rbpf.sensors.readers.part import Part
from rbpf.sensors.stereo import PairConfig, StereoMatcher
from rbpf.systems.stereo.config import MapConfig, StereoConfig

pytestmark = [pytest.mark.real_data, pytest.mark.slow, pytest.mark.usefixtures("keypoints_once")]


def scores(run: Run) -> dict[str, float]:
    assert run.failure is None and run.messages[1:] == []
    assert all("the pair calibrates itself" in message for message in run.messages)
    return scores_of(run)


def test_the_room(data_dir):
    """The truth is good to about a centimetre."""
    run = filter_opened(open_pairs(open_stereo(data_dir / "stereo_zed_room1"), StereoConfig()))
    found = scores(run)
    assert len(run.log) == 105
    assert found["ate_rmse_m"] <= 0.009
    assert found["ate_rmse_m"] <= found["vo_ate_rmse_m"]


def test_the_road(data_dir):
    """It is ahead of odometry with the pair as it is given (0.096 m), and of its own but for the scale."""
    found = scores(filter_opened(open_pairs(open_stereo(data_dir / "stereo_kitti_seq1"), StereoConfig())))
    assert found["ate_sim3_rmse_m"] <= min(0.035, found["vo_ate_sim3_rmse_m"])
    assert found["ate_rmse_m"] <= 0.096
    assert found["vo_rpe_translation_rmse_m"] <= 0.018  # no jump where it begins to calibrate itself


def test_there_and_back_again(data_dir):
    """A path that comes back: with the map better than without, along all of it."""
    sequence = pairs_there_and_back(open_stereo(data_dir / "stereo_zed_room1", part=Part(end_s=1.92)))
    found = scores(filter_opened(open_pairs(sequence, StereoConfig())))
    without = replace(StereoConfig.s05(), map=MapConfig(used=False, kind="particles"))
    off = scores(filter_opened(open_pairs(sequence, without)))
    assert found["ate_rmse_m"] < min(0.006, found["vo_ate_rmse_m"], off["ate_rmse_m"])


# Stereo SIFT features on the stereo recordings, against their ground truth.

PAIRS = 8
START = {"stereo_zed_room1": 0, "stereo_kitti_seq1": 12}
"""In the first frames of KITTI's the true rotations put all features off by 1 to 2 px per frame."""


@pytest.fixture(scope="module", params=START)
def recording(request, data_dir):
    """A rig, its name, and pairs of images with their true poses."""
    sequence = open_stereo(data_dir / request.param)
    frames = [frame for frame, _ in zip(sequence.frames(START[request.param]), range(PAIRS), strict=False)]
    rows = [int(np.abs(sequence.truth.stamps_ns - frame.stamp_ns).argmin()) for frame in frames]
    poses = sequence.truth.poses[rows]
    return sequence.name, sequence.rig, [(frame.image, frame.right) for frame in frames], poses


def features_of(recording, sift=None, stereo=None):
    _, rig, pairs, _ = recording
    sensor = StereoMatcher(rig, Sift(sift), stereo)
    return [sensor.measure(*pair) for pair in pairs]


@pytest.fixture(scope="module")
def features(recording):
    return features_of(recording)


def expected(recording, first, second, points):
    """(u_left, v, u_right) in pair `second` of points in the left camera of pair `first`."""
    _, rig, _, poses = recording
    return rig.project(SE3.transform(SE3.between(poses[second], poses[first]), points))


def test_there_are_enough_features(recording, features):
    least = {"stereo_zed_room1": 60, "stereo_kitti_seq1": 180}[recording[0]]
    assert min(map(len, features)) >= least
    assert max(map(len, features)) <= 1000


@pytest.mark.parametrize(("apart", "fraction"), [(1, 0.85), (3, 0.65)])
def test_they_move_as_the_truth_says(recording, features, apart, fraction):
    errors = []
    for first in range(PAIRS - apart):
        before, after = features[first], features[first + apart]
        matches = match_all(before.descriptors, after.descriptors, MatchLimits())
        there = expected(recording, first, first + apart, before.points[matches.first])
        errors.append(np.abs(after.z[matches.second] - there).max(axis=1))
    error = np.concatenate(errors)
    assert len(error) > 30 * (PAIRS - apart)
    assert np.median(error) < 1.5
    assert np.mean(error < 4.0) > fraction


def test_the_refinement_brings_disparities_closer_to_each_other(recording, features):
    """Of one point in two pairs, less what the true motion changes."""

    def spread(measured):
        out = []
        for first in range(PAIRS - 1):
            matches = match_all(measured[first].descriptors, measured[first + 1].descriptors, MatchLimits())
            there = expected(recording, first, first + 1, measured[first].points[matches.first])
            gap = (measured[first + 1].z[matches.second] - there) @ np.array([1.0, 0.0, -1.0])
            out.append(gap[np.abs(gap) < 3.0])
        gap = np.concatenate(out)
        return np.median(np.abs(gap - np.median(gap)))

    assert spread(features) < 0.75 * spread(features_of(recording, stereo=PairConfig(refine=False)))


def test_a_prediction_finds_landmarks_more_surely(recording, features):
    rig = recording[1]
    before, after, limits = features[0], features[2], MatchLimits()
    mean = expected(recording, 0, 2, before.points)
    seen = np.where(rig.inside(mean)[:, None], mean, np.nan)
    pairs = gate_pairs(after.z, after.cov, seen, np.tile(9.0 * np.eye(3), (len(seen), 1, 1)), 11.3)
    one, other = after.descriptors, before.descriptors
    fractions = []
    for found in (match_all(one, other, limits), match_pairs(one, other, pairs, limits)):
        error = np.abs(after.z[found.first] - mean[found.second]).max(axis=1)
        fractions.append(((error < 4.0).sum(), np.mean(error < 4.0)))
    (free, free_fraction), (gated, gated_fraction) = fractions
    assert gated >= free and gated_fraction > free_fraction and gated_fraction > 0.85
