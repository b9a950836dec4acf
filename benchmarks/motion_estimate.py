"""The motion between two stereo frames from 300 matches, against OpenCV's PnP of the left image alone."""

import cv2
import numpy as np

from benchmarks.rows import Row, Settings, interleaved
from rbpf.lie import SE3
from rbpf.motion.stereo_geometry import Matches
from rbpf.motion.stereo_vo import MotionEstimate, estimate_motion
from rbpf.sensors.camera import Pinhole, RectifiedStereo

MATCHES, FALSE, NOISE_PX = 300, 0.2, 0.5
CAMERA = RectifiedStereo(Pinhole(1241, 376, 718.0, 718.0, 607.0, 185.0), 0.537)
INCREMENT = SE3.exp(np.array([0.003, 0.03, -0.002, 0.02, -0.02, 0.9]))


class TwoFrames:
    """Points 5 to 60 m away, a fifth of them with wrong matches."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)
        depth = self.rng.uniform(5.0, 60.0, (6 * MATCHES, 1))
        px = self.rng.uniform(0.0, [1241.0, 376.0], (6 * MATCHES, 2))
        before = depth * np.concatenate([CAMERA.camera.unproject(px), np.ones_like(depth)], axis=1)
        now = SE3.inverse_transform(INCREMENT, before)
        seen = np.flatnonzero(CAMERA.visible(before) & CAMERA.visible(now))[:MATCHES]
        self.z_prev, self.z_now = (
            CAMERA.project(points[seen]) + NOISE_PX * self.rng.normal(size=(MATCHES, 3)) for points in (before, now)
        )
        false = np.flatnonzero(self.rng.random(MATCHES) < FALSE)
        self.z_now[false] = self.z_now[np.roll(false, 1)]
        self.cov = NOISE_PX**2 * np.eye(3)
        self.matrix = np.array([[718.0, 0.0, 607.0], [0.0, 718.0, 185.0], [0.0, 0.0, 1.0]])

    def ours(self) -> MotionEstimate:
        """Consensus, both images of both frames, covariance."""
        return estimate_motion(Matches.checked(CAMERA, self.z_prev, self.z_now, self.cov, self.cov), self.rng)

    def peer(self) -> np.ndarray:
        """Consensus and refinement in the left image, with exact points and without covariance: the increment (7,)."""
        points, seen = CAMERA.triangulate(self.z_prev), self.z_now[:, :2].copy()
        _, turn, shift, inliers = cv2.solvePnPRansac(
            points, seen, self.matrix, None, reprojectionError=2.0, confidence=0.9999
        )
        rows = inliers[:, 0]
        turn, shift = cv2.solvePnPRefineLM(points[rows], seen[rows], self.matrix, None, turn, shift)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return SE3.inverse(SE3.from_matrix(matrix))


def run(settings: Settings) -> list[Row]:
    """Median over repetitions of one pair of frames."""
    frames = TwoFrames()
    times = interleaved({"rbpf": frames.ours, "opencv": frames.peer}, settings.repetitions(100))
    ours, theirs = times["rbpf"].median * 1e3, times["opencv"].median * 1e3
    errors = [
        np.linalg.norm(SE3.local(INCREMENT, pose)[3:]) * 1e3
        for pose in (frames.ours().previous_camera_from_camera, frames.peer())
    ]
    return [
        Row(
            f"motion of two stereo frames, {MATCHES} matches",
            ours,
            "ms",
            "OpenCV's PnP of the left image",
            theirs,
            theirs / ours,
            notes=(
                f"a fifth of them false; fastest {times['rbpf'].seconds.min() * 1e3:.3g} ms, "
                f"{times['rbpf'].spread}; translation off by {errors[0]:.1f} and {errors[1]:.1f} mm"
            ),
        )
    ]
