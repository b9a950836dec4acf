"""Tracks in the manner of GTSAM's stereo examples: what is read, and what is refused by file and line."""

import re

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers.stereo_tracks import read_stereo_tracks

POSE = SE3.exp(np.array([0.1, -0.2, 0.05, 1.0, 2.0, 3.0]))
CALIBRATION = "700.0 710.0 0.0 600.0 180.0 0.5"
FACTORS = [
    "0 7 620.0 600.0 200.0 0.5 0.5 17.5",
    "0 3 500.0 450.0 100.0 -1.0 -0.8 7.0",
    "1 7 630.0 605.0 210.0 0.6 0.6 14.0",
]


def line(step, matrix):
    return " ".join([str(step), *(f"{entry:.6g}" for entry in matrix.ravel())])


POSES = [line(0, np.eye(4)), line(1, SE3.matrix(POSE))]


def folder(tmp_path, calibration=CALIBRATION, poses=POSES, factors=FACTORS):
    (tmp_path / "VO_calibration.txt").write_text(calibration)
    (tmp_path / "VO_camera_poses.txt").write_text("\n".join(poses) + "\n")
    (tmp_path / "VO_stereo_factors.txt").write_text("\n".join(factors) + "\n")
    return tmp_path


def test_what_is_read(tmp_path):
    tracks = read_stereo_tracks(folder(tmp_path), std_px=0.5, size=(1000, 400))
    log, camera = tracks.log, tracks.log.camera
    one = camera.camera
    assert (one.width, one.height, one.fx, one.fy, one.cx, one.cy) == (1000, 400, 700.0, 710.0, 600.0, 180.0)
    assert camera.baseline_m == 0.5
    assert [frame.stamp_ns for frame in log.frames] == [0, 1]
    np.testing.assert_array_equal(log.frames[0].landmarks, [7, 3])
    np.testing.assert_array_equal(log.frames[0].z, [[620.0, 200.0, 600.0], [500.0, 100.0, 450.0]])
    np.testing.assert_array_equal(log.frames[1].cov_z, [0.25 * np.eye(3)])
    np.testing.assert_allclose(
        SE3.local(np.stack([SE3.identity(), POSE]), tracks.world_from_camera), 0.0, atol=1e-5
    )
    assert log.known is None and log.truth is None


def test_a_frame_that_sees_nothing_is_kept(tmp_path):
    log = read_stereo_tracks(folder(tmp_path, factors=FACTORS[:2])).log
    assert [len(frame.landmarks) for frame in log.frames] == [2, 0]


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"calibration": CALIBRATION + " 1"}, "VO_calibration.txt, line 1: expected 6 columns"),
        ({"calibration": CALIBRATION + "\n" + CALIBRATION}, "VO_calibration.txt, line 2: expected one line"),
        ({"calibration": "700 710 0.1 600 180 0.5"}, "VO_calibration.txt, line 1: expected no skew"),
        (
            {"calibration": "700 710 0 600 180 -0.5"},
            "VO_calibration.txt, line 1: the stereo baseline must be positive",
        ),
        ({"poses": POSES[::-1]}, "VO_camera_poses.txt, line 1: expected frame to be the line's number"),
        ({"poses": [line(0, 2.0 * np.eye(4))]}, "VO_camera_poses.txt, line 1: expected a rotation"),
        (
            {"poses": [line(0, np.diag([1.0, 1.0, -1.0, 1.0]))]},
            "VO_camera_poses.txt, line 1: expected a rotation",
        ),
        (
            {"factors": ["2" + FACTORS[0][1:]]},
            "VO_stereo_factors.txt, line 1: expected frame to be that of a pose",
        ),
        (
            {"factors": [FACTORS[0], FACTORS[0]]},
            "VO_stereo_factors.txt, line 2: landmark 7 comes a second time in frame 0",
        ),
        (
            {"factors": ["0 7 600 620 200 1 1 1"]},
            "VO_stereo_factors.txt, line 1: expected u_left to be greater",
        ),
        (
            {"factors": ["0 7 nan 620 200 1 1 1"]},
            "VO_stereo_factors.txt, line 1: expected u_left to be a finite",
        ),
        (
            {"factors": ["0 7.5 640 620 200 1 1 1"]},
            "VO_stereo_factors.txt, line 1: expected landmark to be a whole",
        ),
    ],
)
def test_a_malformed_file_is_named(tmp_path, changed, complaint):
    with pytest.raises(InputError, match=re.escape(complaint)):
        read_stereo_tracks(folder(tmp_path, **changed))


def test_a_missing_or_second_file_is_named(tmp_path):
    with pytest.raises(
        InputError, match=r"expected one file VO_calibration\*\.txt of stereo tracks, found none"
    ):
        read_stereo_tracks(tmp_path / "nowhere")
    (folder(tmp_path) / "VO_calibration2.txt").write_text(CALIBRATION)
    with pytest.raises(InputError, match=r"found VO_calibration\.txt, VO_calibration2\.txt"):
        read_stereo_tracks(tmp_path)


def test_a_senseless_deviation_is_refused(tmp_path):
    with pytest.raises(InputError, match="must be positive, got 0 px"):
        read_stereo_tracks(folder(tmp_path), std_px=0)
