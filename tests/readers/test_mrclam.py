"""MRCLAM logs: integration of the odometry, what is left out, bad input, the recording."""

import logging
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.readers import LogNoise, open_log
from rbpf.sensors.readers.mrclam import integrate
from tests.readers.fuzzing import is_log_or_one_sentence, mutated, pieces, write

BARCODES = "# subject barcode\n1 5\n2 14\n6 63\n7 81\n"
ODOMETRY = "# time v w\n100.0 0.5 0.0\n100.3 0.2 1.0\n100.9 0.0 -2.0\n101.4 0.4 0.5\n103.0 0.1 0.1\n"
SIGHTINGS = (
    "# time barcode r b\n100.1 63 3 0.1\n100.1 81 4 -0.2\n100.5 14 2 0\n101.9 81 5 0.3\n102.0 99 5 0\n"
)
TRUTH = "# time x y heading\n100.0 1 2 0.5\n100.5 3 4 -0.5\n"
LANDMARKS = "# subject x y sx sy\n6 1 2 0.1 0.1\n7 3 4 0.1 0.1\n"
MOTION = "Robot3_Odometry.dat"
SEEN = "Robot3_Measurement.dat"


def log_files():
    return {
        "Barcodes.dat": BARCODES,
        MOTION: ODOMETRY,
        SEEN: SIGHTINGS,
        "Robot3_Groundtruth.dat": TRUTH,
        "Landmark_Groundtruth.dat": LANDMARKS,
    }


def opened(folder, files, noise=None):
    return open_log(write(folder, files), noise)


DRIVEN = [(0.2, 0.5, 0), (0.6, 0.2, 1), (0.5, 0, -2), (0.5, 0.4, 0.5)]


def moved(noisy_piece=None, noise=(0.0, 0.0)):
    """The motion of the log from 100.1 s to 101.9 s, piece by piece; one piece with white noise."""
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


def test_frames_are_the_instants_with_a_landmark(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        log = opened(tmp_path, log_files())
    assert (log.name, log.space, log.measurement) == (tmp_path.name, SE2, "range_bearing")
    assert [frame.stamp_ns for frame in log.frames] == [100_100_000_000, 101_900_000_000]
    assert [frame.landmarks.tolist() for frame in log.frames] == [[6, 7], [7]]
    np.testing.assert_array_equal(log.frames[0].z, [[3, 0.1], [4, -0.2]])
    np.testing.assert_allclose(log.frames[1].cov_z, [np.diag([0.12**2, 0.02**2])])
    assert "left out 1 observations of robots and 1 of unknown barcodes" in caplog.text


def test_odometry_is_integrated_exactly(tmp_path):
    frame = opened(tmp_path, log_files()).frames[1]
    np.testing.assert_allclose(frame.delta, moved(), atol=1e-14)


def test_covariance_is_that_of_white_noise(tmp_path):
    noise = LogNoise(std_turn_rate_radps=0.3, std_speed_mps=0.2, scale_odometry=2.0)
    frame = opened(tmp_path, log_files(), noise).frames[1]
    np.testing.assert_allclose(frame.cov_delta, 4 * moved_covariance([0.3, 0.2]), rtol=1e-7, atol=1e-10)


def test_no_error_of_the_speeds_leaves_no_covariance(tmp_path):
    noise = LogNoise(std_turn_rate_radps=0.0, std_speed_mps=0.0)
    np.testing.assert_array_equal(opened(tmp_path, log_files(), noise).frames[1].cov_delta, 0)


def test_variance_of_a_straight_motion_grows_with_time_and_the_lever_with_its_cube():
    second = 10**9
    instants = np.array([second, 2 * second, 4 * second])
    readings = np.arange(0, 4 * second, second // 100)
    delta, cov = integrate(readings, np.zeros(400), np.full(400, 0.5), instants)
    np.testing.assert_allclose(delta, [[0.0, 0.5, 0.0], [0.0, 1.0, 0.0]], atol=1e-12)
    turning, driving = cov[:, 0], cov[:, 1]
    np.testing.assert_allclose(turning[:, 0, 0], [1.0, 2.0])
    np.testing.assert_allclose(turning[:, 2, 2], 0.25 * np.array([1.0, 8.0]) / 3, rtol=1e-4)
    np.testing.assert_allclose(driving, [np.diag([0, 1.0, 0]), np.diag([0, 2.0, 0])], atol=1e-12)


def test_the_robot_stands_still_before_the_first_reading():
    second = 10**9
    readings = np.array([3 * second])
    delta, _ = integrate(
        readings, np.array([0.0]), np.array([1.0]), np.array([second, 2 * second, 5 * second])
    )
    np.testing.assert_allclose(delta, [[0, 0, 0], [0, 2, 0]])


def test_a_single_instant_has_no_motion(tmp_path):
    log = opened(tmp_path, log_files() | {SEEN: "100.1 63 3 0.1\n"})
    assert len(log.frames) == 1
    assert log.frames[0].delta is None


def test_truth(tmp_path):
    truth = opened(tmp_path, log_files()).truth
    assert truth.stamps_ns.tolist() == [100_000_000_000, 100_500_000_000]
    np.testing.assert_array_equal(truth.world_from_robot, [[0.5, 1, 2], [-0.5, 3, 4]])
    np.testing.assert_array_equal(truth.landmarks[7], [3, 4])
    (tmp_path / "Landmark_Groundtruth.dat").unlink()
    assert opened(tmp_path, {}).truth.landmarks == {}
    (tmp_path / "Robot3_Groundtruth.dat").unlink()
    assert open_log(tmp_path).truth is None


def test_one_of_several_robots_is_read_by_its_measurements(tmp_path):
    write(tmp_path, log_files() | {"Robot4_Measurement.dat": SIGHTINGS})
    with pytest.raises(InputError, match=r"those of 2 robots; name one, such as .*Robot3_Measurement\.dat\."):
        open_log(tmp_path)
    log = open_log(tmp_path / SEEN)
    assert log.name == f"{tmp_path.name}_Robot3"
    assert len(log.frames) == 2


def test_noise_that_has_no_effect_is_refused(tmp_path):
    with pytest.raises(InputError, match="std_position_m has no effect on an MRCLAM log"):
        opened(tmp_path, log_files(), LogNoise(std_position_m=1.0))


@pytest.mark.parametrize(
    ("file", "line", "text", "expected"),
    [
        ("Barcodes.dat", 3, "3 5", "barcode 5 comes a second time"),
        ("Barcodes.dat", 3, "2 14.5", "expected barcode to be a whole number"),
        ("Barcodes.dat", 3, "0 14", "expected subject to be 1 or more"),
        (MOTION, 3, "100.3 0.2", "expected 3 columns (time, forward speed, turn rate), found 2"),
        (MOTION, 3, "99.9 0.2 1.0", "time runs backwards from 100.0 to 99.9"),
        (MOTION, 3, "100.3 0.2 inf", "expected turn rate to be a finite number, found 'inf'"),
        (SEEN, 4, "100.5 14 0 0", "expected range to be positive, found 0"),
        (SEEN, 4, "100.5 14 -2 0", "expected range to be positive, found -2"),
        (SEEN, 4, "100.5 14 2 30", "expected bearing to be in radians, within a turn, found 30"),
        (SEEN, 4, "99.5 14 2 0", "time runs backwards from 100.1 to 99.5"),
        (SEEN, 4, "100.5 1e20 2 0", "expected barcode to be at most 1e+12"),
        ("Robot3_Groundtruth.dat", 3, "99.5 3 4 0", "time runs backwards from 100.0 to 99.5"),
        ("Landmark_Groundtruth.dat", 3, "6 3 4 0 0", "subject 6 comes a second time"),
        ("Landmark_Groundtruth.dat", 3, "7 3 4 0 -1", "expected std of y to be zero or positive"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, file, line, text, expected):
    files = log_files()
    rows = files[file].split("\n")
    rows[line - 1] = text
    files[file] = "\n".join(rows)
    with pytest.raises(InputError, match=re.escape(f"{file}, line {line}: {expected}")):
        opened(tmp_path, files)


def test_odometry_that_ends_too_early(tmp_path):
    files = log_files() | {SEEN: "100.1 63 3 0.1\n104.7 63 3 0.1\n"}
    message = f"{MOTION}, line 6: the odometry ends 1.700 s before the last observation"
    with pytest.raises(InputError, match=re.escape(message)):
        opened(tmp_path, files)


def test_a_log_without_landmarks(tmp_path):
    with pytest.raises(InputError, match=r"Robot3_Measurement\.dat: expected observations of landmarks"):
        opened(tmp_path, log_files() | {SEEN: "100.1 5 3 0.1\n"})


@pytest.mark.parametrize("file", ["Barcodes.dat", MOTION])
def test_a_missing_file_is_named_with_what_the_folder_needs(tmp_path, file):
    write(tmp_path, log_files())
    (tmp_path / file).unlink()
    with pytest.raises(InputError, match="no such file; expected an MRCLAM log") as caught:
        open_log(tmp_path)
    assert str(tmp_path / file) in str(caught.value)


def test_missing_measurements(tmp_path):
    with pytest.raises(InputError, match=r"expected an MRCLAM log .*; found none\."):
        opened(tmp_path, {"Barcodes.dat": BARCODES})


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("mrclam")


@given(data=st.data())
def test_any_mutation_gives_a_log_or_one_sentence(scratch, data):
    files = mutated(data, log_files(), pieces(b" ", b"#"))
    assert is_log_or_one_sentence(write(scratch, files))


@given(name=st.sampled_from(["Barcodes.dat", MOTION, SEEN]), data=st.binary(max_size=200))
def test_garbage_is_refused(scratch, name, data):
    with pytest.raises(InputError, match=re.escape(name)):
        opened(scratch, log_files() | {name: data})


@pytest.fixture(scope="module")
def recording(data_dir):
    return open_log(data_dir / "mrclam6_robot1")


def truth_at_frames(log):
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    start = log.truth.stamps_ns[0]
    truth = log.truth.world_from_robot
    seconds, known = (stamps - start) / 1e9, (log.truth.stamps_ns - start) / 1e9
    columns = [np.unwrap(truth[:, 0]), truth[:, 1], truth[:, 2]]
    return np.stack([np.interp(seconds, known, column) for column in columns], axis=1)


@pytest.mark.real_data
def test_counts_of_the_recording(recording):
    assert len(recording.frames) == 1012
    assert sum(len(frame.z) for frame in recording.frames) == 1534
    assert all(len(frame.z) for frame in recording.frames)
    assert sorted(recording.truth.landmarks) == list(range(6, 21))
    assert recording.frames[0].stamp_ns == 1_248_444_189_599_000_000
    assert len(recording.truth.stamps_ns) == 49241


@pytest.mark.real_data
def test_dead_reckoning_of_the_recording(recording):
    path = [SE2.identity()]
    for frame in recording.frames[1:]:
        path.append(SE2.compose(path[-1], frame.delta))
    estimate = np.array(path)[:, 1:] @ [1, 1j]
    truth = truth_at_frames(recording)[:, 1:] @ [1, 1j]
    estimate, truth = estimate - estimate.mean(), truth - truth.mean()
    rotation = np.vdot(estimate, truth)
    aligned = estimate * rotation / abs(rotation)
    assert np.sqrt(np.mean(np.abs(aligned - truth) ** 2)) == pytest.approx(2.06, abs=5e-3)


@pytest.mark.real_data
def test_sightings_of_the_recording_agree_with_the_truth(recording):
    parts = []
    for world_from_robot, frame in zip(truth_at_frames(recording), recording.frames, strict=True):
        points = np.array([recording.truth.landmarks[name] for name in frame.landmarks.tolist()])
        x, y = SE2.inverse_transform(world_from_robot, points).T
        parts.append(frame.z - np.stack([np.hypot(x, y), np.arctan2(y, x)], axis=1))
    residuals = np.concatenate(parts)
    centre = np.median(residuals, axis=0)
    robust = 1.4826 * np.median(np.abs(residuals - centre), axis=0)
    np.testing.assert_allclose(centre, [0.038, 0.0], atol=2e-3)
    np.testing.assert_allclose(robust, [0.079, 0.011], atol=1e-3)


@pytest.mark.real_data
def test_the_recording_is_read_without_a_loop_over_its_rows(data_dir, monkeypatch):
    monkeypatch.setattr("rbpf.sensors.readers.text._parse_row", None)
    assert len(open_log(data_dir / "mrclam6_robot1").frames) == 1012
