"""Robot logs: what each format means, and what the recordings hold."""

import logging
import re

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.sensors.readers import LogNoise, open_log
from tests.readers.small import COV_6D, DELTA_6D, GRAPH, MRCLAM, MRPT, MRPT_IN_SPACE, QUARTER, write

SEEN = "Robot3_Measurement.dat"
DRIVEN = [(0.2, 0.5, 0), (0.6, 0.2, 1), (0.5, 0, -2), (0.5, 0.4, 0.5)]
TURNED = [[9, -0.75, -0.25], [-0.75, 4, -0.5], [-0.25, -0.5, 1]]
"""Of x, y, heading (1, 0.5, 0.25; 4, -0.75; 9): reordered, and turned into a body whose x axis is the old y axis."""


def opened(folder, files, noise=None):
    return open_log(write(folder, files), noise)


def graph_of(folder, noise=None):
    return open_log(write(folder, GRAPH) / "graph.txt", noise)


def moved(noisy_piece=None, noise=(0.0, 0.0)):
    """The motion of the MRCLAM log from 100.1 s to 101.9 s, piece by piece; one piece with white noise."""
    out = SE2.identity()
    for number, (dt, speed, turn_rate) in enumerate(DRIVEN):
        xi = dt * np.array([turn_rate, speed, 0.0])
        if number == noisy_piece:
            xi[:2] += np.sqrt(dt) * np.asarray(noise)
        out = SE2.retract(out, xi)
    return out


def moved_covariance(std):
    """Sum over pieces of numeric derivatives by their noise."""
    step, cov = 1e-6, np.zeros((3, 3))
    for number in range(len(DRIVEN)):
        for source in range(2):
            noise = step * np.eye(2)[source]
            plus, minus = moved(number, noise), moved(number, -noise)
            column = (SE2.local(moved(), plus) - SE2.local(moved(), minus)) / (2 * step) * std[source]
            cov += np.outer(column, column)
    return cov


def test_frames_of_mrclam_are_the_instants_with_a_landmark(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        log = opened(tmp_path, MRCLAM)
    assert (log.name, log.space, log.measurement) == (tmp_path.name, SE2, "range_bearing")
    assert [frame.stamp_ns for frame in log.frames] == [100_100_000_000, 101_900_000_000]
    assert [frame.landmarks.tolist() for frame in log.frames] == [[6, 7], [7]]
    np.testing.assert_allclose(log.frames[0].z, [[3 / np.cos(0.1), 0.1], [4 / np.cos(0.2), -0.2]])
    by_depth, by_bearing = 1.0 / np.cos(0.3), 5.0 * np.sin(0.3) / np.cos(0.3) ** 2
    gain = np.array([[by_depth, by_bearing], [0.0, 1.0]])
    np.testing.assert_allclose(log.frames[1].cov_z, [gain @ np.diag([0.06**2, 0.02**2]) @ gain.T])
    np.testing.assert_allclose(log.frames[1].delta, moved(), atol=1e-14)
    assert "left out 1 observations of robots and 1 of unknown barcodes" in caplog.text
    log = opened(tmp_path, {SEEN: "100.1 63 3 0.1\n"})
    assert len(log.frames) == 1 and log.frames[0].delta is None
    # No camera looks so far to the side: this is a range.
    log = opened(tmp_path, {SEEN: "100.1 63 3 1.5\n"})
    np.testing.assert_array_equal(log.frames[0].z, [[3, 1.5]])
    assert "ranges are taken as they are" in caplog.text


def test_covariance_of_mrclam_is_that_of_white_noise(tmp_path):
    noise = LogNoise(std_turn_rate_radps=0.3, std_speed_mps=0.2, scale_odometry=2.0)
    frame = opened(tmp_path, MRCLAM, noise).frames[1]
    np.testing.assert_allclose(frame.cov_delta, 4 * moved_covariance([0.3, 0.2]), rtol=1e-7, atol=1e-10)
    noise = LogNoise(std_turn_rate_radps=0.0, std_speed_mps=0.0)
    np.testing.assert_array_equal(open_log(tmp_path, noise).frames[1].cov_delta, 0)


def test_of_several_recordings_in_a_folder_one_is_named(tmp_path):
    write(tmp_path, MRCLAM | {"Robot4_Measurement.dat": MRCLAM[SEEN]})
    with pytest.raises(InputError, match=r"those of 2 robots; name one, such as .*Robot3_Measurement\.dat\."):
        open_log(tmp_path)
    log = open_log(tmp_path / SEEN)
    assert (log.name, len(log.frames)) == (f"{tmp_path.name}_Robot3", 2)
    graphs = write(tmp_path / "graphs", GRAPH | {"notes.txt": "nothing\n"})
    assert open_log(graphs).name == "graph"
    write(graphs, {"other.txt": GRAPH["graph.txt"]})
    with pytest.raises(InputError, match=r"found 2; name one, such as .*graph\.txt\."):
        open_log(graphs)


def test_mrpt_in_the_plane(tmp_path):
    log = opened(tmp_path, MRPT)
    assert (log.name, log.space, log.measurement) == (tmp_path.name, SE2, "range_bearing")
    assert log.pitch_sign == -1.0
    np.testing.assert_allclose(log.robot_from_sensor, [QUARTER, 0.5, -0.25])
    assert [frame.stamp_ns for frame in log.frames] == [0, 1, 2]
    assert [frame.landmarks.tolist() for frame in log.frames] == [[7, 8], [], [7]]
    assert log.frames[0].delta is None and log.frames[0].cov_delta is None
    assert log.frames[1].z.shape == (0, 2)
    np.testing.assert_array_equal(log.frames[0].z, [[3, 0.1], [4, -0.2]])
    np.testing.assert_allclose(log.frames[0].cov_z[1], np.diag([0.0009, 0.0016]))
    np.testing.assert_allclose(log.frames[1].delta, [QUARTER, 1, 2])
    np.testing.assert_allclose(log.frames[1].cov_delta, TURNED, atol=1e-15)
    # A singular covariance stays singular.
    singular = MRPT["odometry.csv"].replace("2,1,0,0,1,0,0,1,0,1", "2,1,0,0,1,0,0,0,0,0")
    cov = opened(tmp_path, {"odometry.csv": singular}).frames[2].cov_delta
    np.testing.assert_array_equal(cov, np.diag([0, 1, 0]))


def test_mrpt_in_space(tmp_path):
    log = opened(tmp_path, MRPT_IN_SPACE)
    assert (log.space, log.pitch_sign) == (SE3, 1.0)
    np.testing.assert_array_equal(log.frames[0].z, [[3, 0.1, 0.2]])
    np.testing.assert_allclose(log.frames[1].cov_z, [np.diag([0.0009, 0.0016, 0.0025])])
    np.testing.assert_allclose(log.robot_from_sensor, SE3.from_ypr(np.array([0.5, -0.25, 2]), QUARTER, 0, 0))
    np.testing.assert_allclose(log.truth.poses[1], log.frames[1].delta)
    np.testing.assert_array_equal(log.truth.landmarks[7], [1, 2, 3])

    def element(additive):
        return SE3.from_ypr(additive[:3], *additive[3:])

    # The covariance by a numeric Jacobian.
    middle, step = element(DELTA_6D), 1e-6 * np.eye(6)
    columns = [SE3.local(middle, element(DELTA_6D + e)) - SE3.local(middle, element(DELTA_6D - e)) for e in step]
    jacobian = np.stack(columns, axis=1) / 2e-6
    np.testing.assert_allclose(log.frames[1].delta, middle)
    np.testing.assert_allclose(log.frames[1].cov_delta, jacobian @ COV_6D @ jacobian.T, rtol=1e-7, atol=1e-8)
    far = MRPT_IN_SPACE["observations.csv"].replace("-0.3", "-1.6")
    with pytest.raises(InputError, match=r"observations\.csv, line 3: expected pitch_rad to be in radians"):
        opened(tmp_path, {"observations.csv": far})


def test_every_pose_of_a_graph_is_a_frame(tmp_path):
    log = graph_of(tmp_path)
    assert (log.name, log.space, log.measurement, log.truth) == ("graph", SE2, "position", None)
    np.testing.assert_array_equal(log.robot_from_sensor, [0, 0, 0])
    assert [frame.stamp_ns for frame in log.frames] == [0, 1, 2]
    assert [frame.landmarks.tolist() for frame in log.frames] == [[], [2, 4], [4, 2]]
    np.testing.assert_array_equal(log.frames[1].z, [[3, -4], [7, 8]])
    np.testing.assert_array_equal(log.frames[1].cov_z[0], [[0.5, 0.1], [0.1, 0.25]])
    assert log.frames[0].delta is None
    np.testing.assert_allclose(log.frames[1].delta, [QUARTER, 1, 2])
    np.testing.assert_allclose(log.frames[1].cov_delta, TURNED, atol=1e-15)
    np.testing.assert_array_equal(log.frames[2].cov_delta, np.diag([1, 1, 0]))


@pytest.mark.parametrize(
    ("files", "path", "landmarks", "stamps"),
    [
        (MRCLAM, "Robot3_Groundtruth.dat", "Landmark_Groundtruth.dat", [100_000_000_000, 100_500_000_000]),
        (MRPT, "robot_path_groundtruth.csv", "landmarks_groundtruth.csv", [0, 1]),
    ],
    ids=["MRCLAM", "MRPT"],
)
def test_truth_may_be_whole_partial_or_missing(tmp_path, files, path, landmarks, stamps):
    truth = opened(tmp_path, files).truth
    assert truth.stamps_ns.tolist() == stamps
    np.testing.assert_array_equal(truth.poses, [[0.5, 1, 2], [-0.5, 3, 4]])
    np.testing.assert_array_equal(next(iter(truth.landmarks.values())), [1, 2])
    assert all(position.shape == (2,) for position in truth.landmarks.values())
    (tmp_path / path).unlink()
    partial = open_log(tmp_path).truth
    assert partial.poses.shape == (0, 3) and len(partial.landmarks) == 2
    write(tmp_path, {path: files[path]})
    (tmp_path / landmarks).unlink()
    assert open_log(tmp_path).truth.landmarks == {}
    (tmp_path / path).unlink()
    assert open_log(tmp_path).truth is None


def test_given_noise_replaces_that_of_the_log(tmp_path):
    plain = opened(tmp_path / "space", MRPT_IN_SPACE)
    noise = LogNoise(std_range_m=1, std_bearing_rad=2, std_pitch_rad=3, scale_odometry=2)
    log = open_log(tmp_path / "space", noise)
    np.testing.assert_array_equal(log.frames[0].cov_z, [np.diag([1, 4, 9])])
    np.testing.assert_allclose(log.frames[1].cov_delta, 4 * plain.frames[1].cov_delta)
    log = graph_of(tmp_path / "graph", LogNoise(std_position_m=2.0, scale_odometry=3.0))
    np.testing.assert_array_equal(log.frames[1].cov_z[0], 4 * np.eye(2))
    np.testing.assert_array_equal(log.frames[2].cov_delta, np.diag([9, 9, 0]))


@pytest.mark.parametrize(
    ("files", "kind", "names"),
    [
        (MRCLAM, "an MRCLAM log", ["std_position_m"]),
        (MRPT, "an MRPT log in the plane", ["std_pitch_rad", "std_speed_mps", "std_position_m"]),
        (GRAPH, "a graph of landmark positions", ["std_range_m"]),
    ],
)
def test_noise_that_has_no_effect_is_refused(tmp_path, files, kind, names):
    write(tmp_path, files)
    for name in names:
        with pytest.raises(InputError, match=re.escape(f"{name} has no effect on {kind}; leave it out")):
            open_log(tmp_path, LogNoise(**{name: 1.0}))
