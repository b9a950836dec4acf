"""Feature logs: what is refused, and with which sentence."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints, Truth

CAMERA = Pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
STEREO = RectifiedStereo(CAMERA, 0.1)


def frame(stamp_ns: int, count: int, dim: int = 2) -> FeatureFrame:
    z = 100.0 + np.arange(count * dim, dtype=float).reshape(count, dim)
    return FeatureFrame(stamp_ns, np.arange(10, 10 + count), z, np.tile(0.25 * np.eye(dim), (count, 1, 1)))


def log(*frames: FeatureFrame, camera: Pinhole | RectifiedStereo = CAMERA) -> FeatureLog:
    return FeatureLog("walk", camera, list(frames))


def refused(message: str):
    return pytest.raises(InputError, match=f"^{re.escape(message)}")


def test_stereo_measures_three_numbers():
    assert log(frame(0, 4, dim=3), camera=STEREO).camera.dim == 3
    with refused("frame 0 of walk: the array z must hold numbers of shape (K = 4, p = 3), got (4, 2) float64"):
        log(frame(0, 4), camera=STEREO)


def test_a_covariance_may_be_singular_and_there_must_be_frames_in_order():
    exact = replace(frame(0, 2), cov_z=np.stack([np.zeros((2, 2)), np.ones((2, 2))]))
    assert log(exact).frames == [exact]
    with refused("walk holds no frame, expected at least one image"):
        log()
    with refused("frame 2 of walk at 4 ns is before the frame it follows (5 ns): sort the frames by time"):
        log(frame(0, 1), frame(5, 1), frame(4, 1))


POINTS = KnownPoints(np.array([4, 2]), np.zeros((2, 3)), np.zeros((2, 3, 3)))
POSES = np.tile([0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0], (3, 1))
TRUTH = Truth(np.array([0, 5, 5]), POSES, {3: np.zeros(3)})
MADE = {
    "frame 1 of walk": lambda **wrong: log(frame(0, 2), replace(frame(3, 2), **wrong), frame(4, 2)),
    "the known points": lambda **wrong: replace(POINTS, **wrong),
    "the ground truth": lambda **wrong: replace(TRUTH, **wrong),
}
WRONG = [
    ("frame 1 of walk", "stamp_ns", 1.5, "stamp_ns must be a whole number of nanoseconds, got 1.5"),
    ("frame 1 of walk", "landmarks", np.array([1.0, 2.0]),
     "the array landmarks must hold whole numbers of shape (K), got (2,) float64"),
    ("frame 1 of walk", "landmarks", np.array([7, 7]), "the array landmarks must hold distinct numbers (keep "),
    ("frame 1 of walk", "landmarks", np.array([1, 2, 3]),
     "the array z must hold numbers of shape (K = 3, p = 2), got (2, 2) float64"),
    ("frame 1 of walk", "z", np.array([[1.0, 2.0], [np.nan, 4.0]]), "the array z must hold finite numbers, got nan at 1, 0"),
    ("frame 1 of walk", "z", [[1.0, 2.0], [3.0, 4.0]], "z must be an array, got a list"),
    ("frame 1 of walk", "cov_z", np.stack([np.eye(2), np.diag([1.0, -1.0])]), "the array cov_z must hold covariances: "),
    ("the known points", "names", np.array([4, 4]), "the array names must hold distinct numbers (keep "),
    ("the known points", "positions", np.zeros((2, 2)),
     "the array positions must hold numbers of shape (M = 2, 3), got (2, 2) float64"),
    ("the known points", "cov", np.tile(-np.eye(3), (2, 1, 1)), "the array cov must hold covariances: "),
    ("the ground truth", "stamps_ns", np.array([0.0, 1.0, 2.0]),
     "the array stamps_ns must hold whole numbers of shape (T), got (3,) float64"),
    ("the ground truth", "stamps_ns", np.array([0, 1]),
     "the array poses must hold numbers of shape (T = 2, 7), got (3, 7) float64"),
    ("the ground truth", "stamps_ns", np.array([0, 5, 4]), "the array stamps_ns must hold numbers in order (sort "),
    ("the ground truth", "poses", POSES * [1, 1, 1, 2, 1, 1, 1],
     "the array poses must hold poses, of unit quaternions, got 2.0 at 0, 3"),
    ("the ground truth", "landmarks", {8: np.zeros(2)},
     "the array landmark 8 must hold numbers of shape (3), got (2,) float64"),
]  # fmt: skip


@pytest.mark.parametrize(("of", "field", "wrong", "message"), WRONG)
def test_what_is_wrong_is_named(of, field, wrong, message):
    with refused(f"{of}: {message}"):
        MADE[of](**{field: wrong})
