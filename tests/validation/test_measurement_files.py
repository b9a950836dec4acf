"""Measurements of robots and cameras: checks, files that come back bit by bit, files that are refused."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.runs.measurement_files import (
    FRAMES,
    KNOWN,
    OBSERVATIONS,
    ODOMETRY,
    read_feature_log,
    read_measurements,
    write_measurements,
)
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.sensors.readers.measurements import Measurements
from tests.validation.worlds import seen, world

FIELDS = [field for field in Measurements.__dataclass_fields__ if field != "space"]


def assert_same(found, expected):
    assert found.space is expected.space
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field), strict=True)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["range_bearing", "position"])
def test_files_give_back_the_same_bits(tmp_path, dim, kind):
    m = world(dim, kind)
    write_measurements(tmp_path, m)
    assert_same(read_measurements(tmp_path), m)
    assert sorted(path.name for path in tmp_path.iterdir()) == [OBSERVATIONS, ODOMETRY]


def test_extreme_numbers_come_back(tmp_path):
    m = world(2, "position")
    z, covs = m.z.copy(), m.covs.copy()
    z[0] = [5e-324, -1e12]
    covs[0] = np.diag([0.0, 1e-300, np.nextafter(1.0, 2.0)])
    m = replace(m, z=z, covs=covs, landmarks=m.landmarks - 2**62, recording="zurich, 2nd: été")
    write_measurements(tmp_path, m)
    assert_same(read_measurements(tmp_path), m)


def test_a_run_without_sightings_and_one_of_a_single_step_come_back(tmp_path):
    m = world(3, "position")
    blind = seen(m, m.steps[:0], m.landmarks[:0], m.z[:0], m.cov_z[:0])
    first = m.steps == 0
    single = seen(m, m.steps[first], m.landmarks[first], m.z[first], m.cov_z[first])
    single = replace(single, stamps_ns=m.stamps_ns[:1], deltas=m.deltas[:0], covs=m.covs[:0])
    for short in (blind, single):
        write_measurements(tmp_path, short)
        assert_same(read_measurements(tmp_path), short)


def test_the_files_are_as_documented(tmp_path):
    m = world(2, "range_bearing")
    write_measurements(tmp_path, m)
    lines = (tmp_path / OBSERVATIONS).read_text().splitlines()
    assert lines[0] == "# rbpf observations 1"
    assert lines[4:6] == ["# pitch_sign: -1", "# robot_from_sensor: 2.4 0.3 -0.2"]
    assert lines[9] == "step,stamp_ns,landmark,z0,z1,c00,c10,c11"
    row = lines[10].split(",")
    assert row[:3] == [str(m.steps[0]), str(m.stamps_ns[m.steps[0]]), str(m.landmarks[0])]
    assert [float(x) for x in row[5:]] == [m.cov_z[0, 0, 0], m.cov_z[0, 1, 0], m.cov_z[0, 1, 1]]
    lines = (tmp_path / ODOMETRY).read_text().splitlines()
    assert lines[4] == "step,stamp_ns,d0,d1,d2,c00,c10,c11,c20,c21,c22"
    assert lines[5].split(",")[:3] == ["1", str(m.stamps_ns[1]), repr(float(m.deltas[0, 0]))]


@pytest.mark.parametrize("name", [OBSERVATIONS, ODOMETRY])
def test_missing_and_cut_files_are_refused(tmp_path, name):
    write_measurements(tmp_path, world(2, "position"))
    path = tmp_path / name
    text = path.read_text()
    for cut in (text[:-3], text[: text.rindex("\n", 0, -1) + 1], text[:20], text[: text.index("step")], ""):
        path.write_text(cut)
        with pytest.raises(InputError, match=re.escape(str(path))):
            read_measurements(tmp_path)
    path.unlink()
    with pytest.raises(InputError, match="no such file; expected a file that every filter run writes"):
        read_measurements(tmp_path)


BAD_SIGHTINGS = [
    ("0,1700000000123456789,41,", "0,1700000000123456789,41,1,", "line 11: expected 8 columns .* found 9"),
    ("0,1700000000123456789,41,", "0,1700000000123456789,", "line 11: expected 8 columns .* found 7"),
    ("0,1700000000123456789,41,", "7,1700000000123456789,41,", "line 11: expected a step from 0 to 6"),
    ("0,1700000000123456789,41,", "-1,1700000000123456789,41,", "line 11: expected a step from 0 to 6"),
    ("0,1700000000123456789,41,", "0,1700000000123456788,41,", "line 11: expected the stamp that"),
    ("0,1700000000123456789,41,", "0,1700000000123456789,4.1,", "expected landmark to be a whole number"),
    ("0,1700000000123456789,41,", "0,99999999999999999999,41,", "expected stamp_ns to be a whole number"),
    ("# rbpf observations 1", "# rbpf observations 2", "line 1: expected '# rbpf obs"),
    ("# space: SE2", "# space: SO3", "line 3: expected space to be SE2 or SE3, found 'SO3'"),
    ("# measurement: position", "# measurement: range", "expected measurement to be range_bearing"),
    ("# pitch_sign: -1", "# pitch_sign: 2", "expected pitch_sign to be 1 or -1"),
    ("# robot_from_sensor: 2.4", "# robot_from_sensor:", "line 6: expected 3 numbers .* found 2"),
    ("# robot_from_sensor: 2.4", "# robot_from_sensor: nan", "expected robot_from_sensor to be a finite"),
    ("# start: ", "# begin: ", "expected a line '# start: ...' above this one"),
    ("# recording: small world", "# recording: other", "expected recording other .* from one run"),
    ("# rows: 33", "# rows: 34", "expected 34 rows as the header says, found 33"),
    ("# rows: 33", "# rows: many", "line 9: expected rows to be a whole number"),
    ("step,stamp_ns,landmark,z0", "step,stamp_ns,landmark,y0", "line 10: expected the columns step,"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "complaint"), BAD_SIGHTINGS)
def test_malformed_sightings_are_refused_by_line(tmp_path, old, new, complaint):
    write_measurements(tmp_path, world(2, "position"))
    path = tmp_path / OBSERVATIONS
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=complaint):
        read_measurements(tmp_path)


@pytest.mark.parametrize(
    ("dim", "name", "line", "column", "value", "complaint"),
    [
        (2, OBSERVATIONS, 13, 4, "nan", "expected z1 to be a finite number, found 'nan'"),
        (2, OBSERVATIONS, 13, 3, "", "expected z0 to be a finite number, found ''"),
        (2, OBSERVATIONS, 13, 5, "-0.1", "expected a positive semi-definite covariance"),
        (2, OBSERVATIONS, 13, 6, "9.0", "expected a positive semi-definite covariance"),
        (2, ODOMETRY, 8, 0, "4", "expected one row per step, from step 1 in order"),
        (2, ODOMETRY, 8, 1, "17", "expected stamps in order of time"),
        (2, ODOMETRY, 8, 2, "inf", "expected d0 to be a finite number"),
        (2, ODOMETRY, 8, -1, "-0.1", "expected a positive semi-definite covariance"),
        (3, ODOMETRY, 7, 5, "3.0", "expected an increment that begins with a quaternion"),
    ],
)
def test_malformed_numbers_are_refused_by_line(tmp_path, dim, name, line, column, value, complaint):
    write_measurements(tmp_path, world(dim, "position"))
    lines = (tmp_path / name).read_text().splitlines()
    fields = lines[line - 1].split(",")
    fields[column] = value
    lines[line - 1] = ",".join(fields)
    (tmp_path / name).write_text("\n".join([*lines, ""]))
    with pytest.raises(InputError, match=re.escape(str(tmp_path / name)) + f", line {line}: {complaint}"):
        read_measurements(tmp_path)


@pytest.mark.parametrize(
    ("dim", "change", "complaint"),
    [
        (2, {"recording": "two\nlines"}, "name on one line"),
        (2, {"recording": ""}, "name on one line"),
        (2, {"measurement": "bearing"}, "a measurement range_bearing or position"),
        (2, {"pitch_sign": 0.5}, "a pitch sign 1 or -1"),
        (2, {"start": np.zeros(7)}, re.escape("start of shape (3,), found (7,)")),
        (2, {"start": np.array([0.0, np.inf, 0.0])}, "finite numbers .* in start"),
        (2, {"stamps_ns": np.arange(7)[::-1]}, "order of time"),
        (2, {"steps": np.full(33, 7)}, "from 0 to 6"),
        (2, {"covs": np.tile(np.diag([1.0, -1.0, 1.0]), (6, 1, 1))}, "covariances in covs, .* row 0"),
        (3, {"start": np.zeros(7)}, "quaternions of length 1"),
    ],
)
def test_what_does_not_fit_together_is_refused(dim, change, complaint):
    with pytest.raises(InputError, match=complaint):
        replace(world(dim, "position"), **change)


CAMERA = Pinhole(640, 480, 512.1, 511.9, 319.4, 239.6, (0.1, -0.05, 1e-3, -2e-3, 0.01))


def log(known: bool = True, camera: Pinhole | RectifiedStereo = CAMERA) -> FeatureLog:
    """Four frames, of which the second saw nothing."""
    p = camera.dim
    rng, frames = np.random.default_rng(0), []
    for t, count in enumerate((5, 0, 3, 4)):
        root = rng.standard_normal((count, p, p))
        cov = root @ np.swapaxes(root, -1, -2) + np.eye(p)
        cov = 0.5 * (cov + np.swapaxes(cov, -1, -2))
        z = rng.uniform(0.0, 480.0, (count, p))
        frames.append(FeatureFrame(1_400_000_000_000_000_000 + t * 33_333_333, np.arange(count) + t, z, cov))
    points = KnownPoints(np.arange(4), rng.standard_normal((4, 3)), np.tile(1e-4 * np.eye(3), (4, 1, 1)))
    return FeatureLog("a desk", camera, frames, points if known else None)


FISHEYE = replace(CAMERA, distortion=(-0.03, 0.02, -0.012, 0.1 + 0.2), distortion_model="equidistant")
PAIR = RectifiedStereo(replace(CAMERA, distortion=(0.0,) * 5), 0.1 + 0.2)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, PAIR])
@pytest.mark.parametrize("known", [True, False])
def test_reading_gives_back_the_same_bits(tmp_path, known, camera):
    write_measurements(tmp_path, log())
    write_measurements(tmp_path, log(known, camera))
    again, original = read_feature_log(tmp_path), log(known, camera)
    assert again.name == original.name and again.camera == original.camera
    for one, other in zip(again.frames, original.frames, strict=True):
        assert one.stamp_ns == other.stamp_ns
        for name in ("landmarks", "z", "cov_z"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert (again.known is None) == (original.known is None)
    if again.known is not None and original.known is not None:
        for name in ("names", "positions", "cov"):
            np.testing.assert_array_equal(getattr(again.known, name), getattr(original.known, name))


@pytest.mark.parametrize(
    ("camera", "name", "old", "new", "words"),
    [
        (CAMERA, OBSERVATIONS, "# measurement: pinhole", "# measurement: range_bearing", "measurement to be pinhole"),
        (CAMERA, OBSERVATIONS, "# size: 640 480", "# size: 640", "expected 2 numbers for size"),
        (CAMERA, OBSERVATIONS, "\n3,", "\n4,", "expected a step from 0 to 3"),
        (CAMERA, OBSERVATIONS, "3,1400000000099999999,", "3,1400000000099999998,", "gives this step"),
        (CAMERA, FRAMES, "# recording: a desk", "# recording: a room", "take both files from one run"),
        (CAMERA, FRAMES, "\n2,", "\n5,", "one row per frame"),
        (CAMERA, KNOWN, "# rows: 4", "# rows: four", "expected rows to be a whole number"),
        (PAIR, OBSERVATIONS, "# baseline: 0.3", "# baseline: -0.3", "baseline must be positive"),
        (PAIR, OBSERVATIONS, "# baseline: ", "# base: ", "expected a line '# baseline"),
        (PAIR, OBSERVATIONS, "u_right_px", "u_px", "expected the columns"),
        (PAIR, OBSERVATIONS, "# measurement: stereo", "# measurement: pinhole", "expected the columns"),
        (FISHEYE, OBSERVATIONS, "# lens: equidistant", "# lens: fov", "radial-tangential or equidistant, found 'fov'"),
        (FISHEYE, OBSERVATIONS, "# lens: equidistant", "# lens: radial-tangential", "expected 9 numbers for camera"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, camera, name, old, new, words):
    write_measurements(tmp_path, log(camera=camera))
    text = (tmp_path / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as error:
        read_feature_log(tmp_path)
    assert name in str(error.value)
