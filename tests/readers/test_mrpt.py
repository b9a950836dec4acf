"""MRPT logs: charts of the odometry's covariance, conventions, bad input."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.sensors.readers import LogNoise, open_log
from tests.readers.fuzzing import is_log_or_one_sentence, mutated, pieces, write

PLANAR = "step,dx_m,dy_m,dphi_rad,cxx,cxy,cxp,cyy,cyp,cpp"
TRIANGLE = ",".join(f"cov{i}{j}" for i in range(6) for j in range(i, 6))
SPATIAL = f"step,dx_m,dy_m,dz_m,yaw_rad,pitch_rad,roll_rad,{TRIANGLE}"
SIGHTINGS = "step,landmark_id,range_m,yaw_rad,pitch_rad,std_range_m,std_yaw_rad,std_pitch_rad"
SENSOR = """# where the sensor sits
robot_from_sensor: {x_m: 0.5, y_m: -0.25, z_m: 2, yaw_deg: 90, pitch_deg: 0, roll_deg: 0}
std: {range_m: 0.1, yaw_deg: 1}
positive_pitch: down
"""
POSE = "step,x_m,y_m,z_m,yaw_rad,pitch_rad,roll_rad"
QUARTER = np.pi / 2
RNG = np.random.default_rng(3)
DELTA_6D = np.array([1.0, -2.0, 0.5, 0.7, -0.4, 2.1])
FACTOR_6D = RNG.normal(size=(6, 6))
COV_6D = FACTOR_6D @ FACTOR_6D.T


def numbers(values):
    return ",".join(format(float(v), ".17g") for v in values)


def lines(*rows):
    return "\n".join(rows) + "\n"


def planar_files():
    return {
        "odometry.csv": lines(
            PLANAR, f"1,1,2,{QUARTER!r},1,0.5,0.25,4,-0.75,9", "2,1,0,0,1,0,0,1,0,1", "3,1,0,0,1,0,0,1,0,1"
        ),
        "observations.csv": lines(
            SIGHTINGS, "0,7,3,0.1,0,0.01,0.02,0", "0,8,4,-0.2,-0,0.03,0.04,0", "2,7,5,0.3,0,0.05,0.06,0"
        ),
        "sensor.yaml": SENSOR,
        "robot_path_groundtruth.csv": lines(POSE, "0,1,2,0,0.5,0,0", "1,3,4,0,-0.5,0,-0"),
        "landmarks_groundtruth.csv": lines("id,x_m,y_m,z_m", "7,1,2,3", "8,4,5,6"),
    }


def spatial_files():
    triangle = numbers(COV_6D[np.triu_indices(6)])
    return {
        "odometry.csv": lines(SPATIAL, f"1,{numbers(DELTA_6D)},{triangle}"),
        "observations.csv": lines(
            SIGHTINGS, "0,7,3,0.1,0.2,0.01,0.02,0.03", "1,8,4,-0.2,-0.3,0.03,0.04,0.05"
        ),
        "sensor.yaml": SENSOR.replace("down", "up"),
        "robot_path_groundtruth.csv": lines(POSE, "0,0,0,0,0,0,0", f"1,{numbers(DELTA_6D)}"),
        "landmarks_groundtruth.csv": lines("id,x_m,y_m,z_m", "7,1,2,3"),
    }


def opened(folder, files, noise=None):
    return open_log(write(folder, files), noise)


def test_frames_of_a_planar_log(tmp_path):
    log = opened(tmp_path, planar_files())
    assert (log.name, log.space, log.measurement, log.pitch_sign) == (
        tmp_path.name,
        SE2,
        "range_bearing",
        -1.0,
    )
    np.testing.assert_allclose(log.robot_from_sensor, [QUARTER, 0.5, -0.25])
    assert [frame.stamp_ns for frame in log.frames] == [0, 1, 2]
    assert [frame.landmarks.tolist() for frame in log.frames] == [[7, 8], [], [7]]
    assert log.frames[0].delta is None
    assert log.frames[0].cov_delta is None
    assert log.frames[1].z.shape == (0, 2)
    np.testing.assert_array_equal(log.frames[0].z, [[3, 0.1], [4, -0.2]])
    np.testing.assert_allclose(log.frames[0].cov_z[1], np.diag([0.0009, 0.0016]))
    np.testing.assert_allclose(log.frames[1].delta, [QUARTER, 1, 2])


def test_planar_covariance_is_reordered_and_turned_into_the_body(tmp_path):
    # A quarter turn to the left: the body's x axis is the old y axis, its y axis the old -x axis.
    cov = opened(tmp_path, planar_files()).frames[1].cov_delta
    np.testing.assert_allclose(cov, [[9, -0.75, -0.25], [-0.75, 4, -0.5], [-0.25, -0.5, 1]], atol=1e-15)


def test_spatial_covariance_matches_a_numeric_jacobian(tmp_path):
    log = opened(tmp_path, spatial_files())
    assert log.space is SE3
    assert log.pitch_sign == 1.0

    def element(additive):
        return SE3.from_ypr(additive[:3], *additive[3:])

    step = 1e-6
    columns = [
        SE3.local(element(DELTA_6D), element(DELTA_6D + e))
        - SE3.local(element(DELTA_6D), element(DELTA_6D - e))
        for e in step * np.eye(6)
    ]
    jacobian = np.stack(columns, axis=1) / (2 * step)
    np.testing.assert_allclose(log.frames[1].delta, element(DELTA_6D))
    np.testing.assert_allclose(log.frames[1].cov_delta, jacobian @ COV_6D @ jacobian.T, rtol=1e-7, atol=1e-8)


def test_spatial_measurement_and_mounting(tmp_path):
    log = opened(tmp_path, spatial_files())
    np.testing.assert_array_equal(log.frames[0].z, [[3, 0.1, 0.2]])
    np.testing.assert_allclose(log.frames[1].cov_z, [np.diag([0.0009, 0.0016, 0.0025])])
    np.testing.assert_allclose(log.robot_from_sensor, SE3.from_ypr(np.array([0.5, -0.25, 2]), QUARTER, 0, 0))
    np.testing.assert_allclose(log.truth.world_from_robot[1], log.frames[1].delta)
    np.testing.assert_array_equal(log.truth.landmarks[7], [1, 2, 3])


def test_truth_of_a_planar_log(tmp_path):
    truth = opened(tmp_path, planar_files()).truth
    assert truth.stamps_ns.tolist() == [0, 1]
    np.testing.assert_array_equal(truth.world_from_robot, [[0.5, 1, 2], [-0.5, 3, 4]])
    assert {name: position.tolist() for name, position in truth.landmarks.items()} == {7: [1, 2], 8: [4, 5]}


def test_truth_may_be_partial_or_missing(tmp_path):
    write(tmp_path, planar_files())
    (tmp_path / "robot_path_groundtruth.csv").unlink()
    truth = opened(tmp_path, {}).truth
    assert truth.world_from_robot.shape == (0, 3)
    assert sorted(truth.landmarks) == [7, 8]
    (tmp_path / "landmarks_groundtruth.csv").unlink()
    assert opened(tmp_path, {}).truth is None


def test_given_noise_replaces_that_of_the_log(tmp_path):
    plain = opened(tmp_path, spatial_files())
    noise = LogNoise(std_range_m=1, std_bearing_rad=2, std_pitch_rad=3, scale_odometry=2)
    log = opened(tmp_path, {}, noise)
    np.testing.assert_array_equal(log.frames[0].cov_z, [np.diag([1, 4, 9])])
    np.testing.assert_allclose(log.frames[1].cov_delta, 4 * plain.frames[1].cov_delta)


def test_noise_that_has_no_effect_is_refused(tmp_path):
    write(tmp_path, planar_files())
    for name in ("std_pitch_rad", "std_speed_mps", "std_position_m"):
        with pytest.raises(InputError, match=f"{name} has no effect"):
            open_log(tmp_path, LogNoise(**{name: 1.0}))


def test_a_singular_covariance_stays_singular(tmp_path):
    files = planar_files()
    files["odometry.csv"] = files["odometry.csv"].replace("2,1,0,0,1,0,0,1,0,1", "2,1,0,0,1,0,0,0,0,0")
    cov = opened(tmp_path, files).frames[2].cov_delta
    np.testing.assert_array_equal(cov, np.diag([0, 1, 0]))


@pytest.mark.parametrize(
    ("file", "line", "text", "expected"),
    [
        ("odometry.csv", 1, "step,x", "expected the header"),
        ("odometry.csv", 3, "1,1,0,0,1,0,0,1,0,1", "expected step to be one more than in the row before"),
        ("odometry.csv", 3, "3,1,0,0,1,0,0,1,0,1", "expected step to be one more than in the row before"),
        ("odometry.csv", 3, "2,1,0,0,1,0,0,1,0", "expected 10 columns"),
        ("odometry.csv", 3, "2,1,,0,1,0,0,1,0,1", "expected dy_m to be a finite number, found ''"),
        ("odometry.csv", 3, "2,1,0,0,-1,0,0,1,0,1", "expected cxx to cpp to be a covariance"),
        ("odometry.csv", 3, "2,1,0,0,1,1.1,0,1,0,1", "expected cxx to cpp to be a covariance"),
        ("odometry.csv", 3, "2,1,0,0,0,1e-9,0,1,0,1", "expected cxx to cpp to be a covariance"),
        ("odometry.csv", 3, "2,1,0,0,1,0.9,-0.9,1,0.9,1", "expected cxx to cpp to be a covariance"),
        ("observations.csv", 2, "-1,7,3,0.1,0,0.01,0.02,0", "expected step to be one with odometry, 0 to 3"),
        ("observations.csv", 4, "4,7,5,0.3,0,0.05,0.06,0", "expected step to be one with odometry, 0 to 3"),
        ("observations.csv", 4, "1e30,7,5,0.3,0,0.05,0.06,0", "expected step to be at most 1e+12"),
        ("observations.csv", 3, "2.5,8,4,0,0,0.03,0.04,0", "expected step to be a whole number, found 2.5"),
        ("observations.csv", 3, "0,7,4,0,0,0.03,0.04,0", "landmark 7 comes a second time in step 0"),
        ("observations.csv", 3, "3,8,4,0,0,0.03,0.04,0", "line 4: time runs backwards from step 3 to 2"),
        ("observations.csv", 3, "0,8,0,0,0,0.03,0.04,0", "expected range_m to be positive, found 0"),
        ("observations.csv", 3, "0,8,-4,0,0,0.03,0.04,0", "expected range_m to be positive, found -4"),
        ("observations.csv", 3, "0,8,4,57,0,0.03,0.04,0", "expected yaw_rad to be in radians"),
        (
            "observations.csv",
            3,
            "0,8,4,0,0.1,0.03,0.04,0",
            "expected pitch_rad to be 0, as the odometry is planar",
        ),
        ("observations.csv", 3, "0,8,4,0,0,-0.03,0.04,0", "expected std_range_m to be positive"),
        ("observations.csv", 3, "0,8,4,0,0,0.03,0,0", "expected std_yaw_rad to be positive"),
        ("observations.csv", 3, "0,8,4,0,0,0.03,0.04,-1", "expected std_pitch_rad to be zero or positive"),
        ("sensor.yaml", 2, "robot_from_sensor: 3", "expected the keys x_m, y_m"),
        ("sensor.yaml", 2, "robot_from_sensor: {x_m: 0}", "found no y_m"),
        (
            "sensor.yaml",
            2,
            SENSOR.split("\n")[1].replace("0.5", "0.5x"),
            "expected x_m to be a finite number",
        ),
        ("sensor.yaml", 2, SENSOR.split("\n")[1].replace("0.5", "[]"), "expected x_m to be a single value"),
        (
            "sensor.yaml",
            2,
            SENSOR.split("\n")[1].replace("roll_deg: 0", "roll_deg: 5"),
            "as the odometry is planar",
        ),
        (
            "sensor.yaml",
            3,
            "x: 1",
            "expected the keys robot_from_sensor, positive_pitch; also known: std; found 'x'",
        ),
        ("sensor.yaml", 4, "positive_pitch: left", "expected positive_pitch to be up or down, found 'left'"),
        ("sensor.yaml", 4, "positive_pitch: }", "expected YAML"),
        ("robot_path_groundtruth.csv", 3, "0,3,4,0,0,0,0", "expected step to be later"),
        ("robot_path_groundtruth.csv", 3, "1,3,4,0,0,0.1,0", "expected pitch_rad to be 0"),
        ("landmarks_groundtruth.csv", 3, "7,1,2,3", "id 7 comes a second time"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, file, line, text, expected):
    files = planar_files()
    rows = files[file].split("\n")
    rows[line - 1] = text
    files[file] = "\n".join(rows)
    place = "" if expected.startswith("line") else f"line {line}: "
    with pytest.raises(InputError, match=re.escape(f"{file}, {place}")) as caught:
        opened(tmp_path, files)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_sensor_file_that_overtaxes_the_parser(tmp_path):
    long_version = f"%YAML {'1' * 5000}.1\n---\na: 1\n"
    for text in ("[" * 5000, '"\\UFFFFFFFF"', long_version, "# nothing\n", "\x01"):
        with pytest.raises(InputError, match=r"sensor\.yaml"):
            opened(tmp_path, planar_files() | {"sensor.yaml": text})


def test_pitch_in_space_is_at_most_a_quarter_turn(tmp_path):
    files = spatial_files()
    files["observations.csv"] = files["observations.csv"].replace("-0.3", "-1.6")
    with pytest.raises(InputError, match=r"observations\.csv, line 3: expected pitch_rad to be in radians"):
        opened(tmp_path, files)


@pytest.mark.parametrize("file", ["odometry.csv", "observations.csv", "sensor.yaml"])
def test_a_missing_file_is_named_with_what_the_folder_needs(tmp_path, file):
    write(tmp_path, planar_files())
    (tmp_path / file).unlink()
    with pytest.raises(InputError, match="no such file; expected an MRPT log") as caught:
        open_log(tmp_path)
    assert str(tmp_path / file) in str(caught.value)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("mrpt")


@given(data=st.data())
def test_any_mutation_gives_a_log_or_one_sentence(scratch, data):
    files = data.draw(st.sampled_from([planar_files(), spatial_files()]))
    assert is_log_or_one_sentence(write(scratch, mutated(data, files, pieces(b",", b"{"))))


@given(
    name=st.sampled_from(["odometry.csv", "observations.csv", "sensor.yaml"]), data=st.binary(max_size=200)
)
def test_garbage_is_refused(scratch, name, data):
    with pytest.raises(InputError, match=re.escape(name)):
        opened(scratch, planar_files() | {name: data})
