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
    ("name", "old", "new", "words"),
    [
        (OBSERVATIONS, "# rbpf observations 1", "# rbpf observations 9", "expected '# rbpf observations 1'"),
        (OBSERVATIONS, "# measurement: pinhole", "# measurement: range_bearing", "expected measurement to be pinhole"),
        (OBSERVATIONS, "# size: 640 480", "# size: 640", "expected 2 numbers for size"),
        (OBSERVATIONS, "\n3,", "\n4,", "expected a step from 0 to 3"),
        (OBSERVATIONS, "# rows: 12", "# rows: 13", "expected 13 rows"),
        (FRAMES, "# recording: a desk", "# recording: a room", "take both files from one run"),
        (FRAMES, "\n2,", "\n5,", "one row per frame"),
        (KNOWN, "# rows: 4", "# rows: four", "expected rows to be a whole number"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, name, old, new, words):
    write_measurements(tmp_path, log())
    text = (tmp_path / name).read_text()
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as error:
        read_feature_log(tmp_path)
    assert name in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("# baseline: 0.3", "# baseline: -0.3", "baseline must be positive"),
        ("# baseline: ", "# base: ", "expected a line '# baseline"),
        ("u_right_px", "u_px", "expected the columns"),
        ("# measurement: stereo", "# measurement: pinhole", "expected the columns"),
    ],
)
def test_a_damaged_file_of_pairs_is_named(tmp_path, old, new, words):
    write_measurements(tmp_path, log(camera=PAIR))
    text = (tmp_path / OBSERVATIONS).read_text()
    assert old in text
    (tmp_path / OBSERVATIONS).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_feature_log(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("# lens: equidistant", "# lens: fov", "expected lens to be radial-tangential or equidistant, found 'fov'"),
        ("# lens: equidistant", "# lens: radial-tangential", "expected 9 numbers for camera, found 8"),
    ],
)
def test_a_damaged_lens_is_named(tmp_path, old, new, words):
    write_measurements(tmp_path, log(camera=FISHEYE))
    text = (tmp_path / OBSERVATIONS).read_text()
    assert old in text
    (tmp_path / OBSERVATIONS).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_feature_log(tmp_path)


def test_a_stamp_that_belongs_to_another_frame_is_refused(tmp_path):
    write_measurements(tmp_path, log())
    write_measurements(tmp_path / ".", replace(log(), frames=log().frames))
    text = (tmp_path / OBSERVATIONS).read_text()
    (tmp_path / OBSERVATIONS).write_text(text.replace("1400000000066666666", "1400000000066666667"))
    with pytest.raises(InputError, match="gives this step"):
        read_feature_log(tmp_path)
