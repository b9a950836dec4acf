"""Measurements of a camera survive a round trip to the last bit, and damaged files are named."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.runs.measurement_files import FRAMES, KNOWN, OBSERVATIONS, read_feature_log, write_measurements
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints

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
