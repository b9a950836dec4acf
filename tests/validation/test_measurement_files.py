"""Measurements of robots and cameras: checks, files that come back bit by bit, files that are refused."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.runs.measurement_files import (
    FRAMES,
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


@pytest.mark.parametrize(
    ("dim", "name", "line", "column", "value", "complaint"),
    [
        (2, OBSERVATIONS, 13, 5, "-0.1", "expected a positive semi-definite covariance"),
        (2, ODOMETRY, 8, 0, "4", "expected one row per step, from step 1 in order"),
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
WORLD, STAMP = world(2, "position"), "170000000012345"
PAIR = RectifiedStereo(replace(CAMERA, distortion=(0.0,) * 5), 0.1 + 0.2)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, PAIR])
@pytest.mark.parametrize("known", [True, False])
def test_reading_gives_back_the_same_bits(tmp_path, known, camera):
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
    ("written", "name", "old", "new", "words"),
    [
        (WORLD, OBSERVATIONS, f"0,{STAMP}6789,41,", f"0,{STAMP}6789,", "line 11: expected 8 columns .* found 7"),
        (WORLD, OBSERVATIONS, f"0,{STAMP}6789,41,", f"0,{STAMP}6788,41,", "line 11: expected the stamp that"),
        (WORLD, OBSERVATIONS, "# robot_from_sensor: 2.4", "# robot_from_sensor:", "line 6: .* 3 numbers .* found 2"),
        (WORLD, OBSERVATIONS, "# recording: small world", "# recording: other", "recording other .* one run"),
        (WORLD, OBSERVATIONS, "# rows: 33", "# rows: 34", "expected 34 rows as the header says, found 33"),
        (log(), OBSERVATIONS, "# measurement: pinhole", "# measurement: range_bearing", "measurement to be pinhole"),
        (log(), OBSERVATIONS, "3,1400000000099999999,", "3,1400000000099999998,", "gives this step"),
        (log(), FRAMES, "# recording: a desk", "# recording: a room", "take both files from one run"),
        (log(camera=PAIR), OBSERVATIONS, "# baseline: 0.3", "# baseline: -0.3", "baseline_m must be above 0"),
        (log(camera=FISHEYE), OBSERVATIONS, "# lens: equidistant", "# lens: radial-tangential", "expected 9 numbers for"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_named(tmp_path, written, name, old, new, words):
    write_measurements(tmp_path, written)
    text = (tmp_path / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as error:
        (read_measurements if written is WORLD else read_feature_log)(tmp_path)
    assert name in str(error.value)
