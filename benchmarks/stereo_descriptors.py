"""Fraction of correct matches of stereo SIFT features: python -m benchmarks.stereo_descriptors FOLDER_OF_RECORDINGS.

A match is correct if it agrees with the consensus motion (`plain_odometry`): the moved point projects to the matched
feature, up to noise (99.9 % of a Gaussian) and 2 px. The recordings' ground truth is not accurate enough: errors of
KITTI's rotations move all features by up to 2 px from frame to frame. Features are matched left to right by descriptors
of 128; descriptors of 36 are computed from the same histograms. Prints the tables of the documentation.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.plain_odometry import path
from rbpf.core.models import NULL
from rbpf.lie import SE3
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.descriptors import MatchLimits, distances, gate_pairs, match_all, match_pairs, two_best
from rbpf.sensors.features import Sift
from rbpf.sensors.features.sift import SiftConfig, descriptors_from_histograms
from rbpf.sensors.landmark_management import LandmarkManager, NewLandmarkConfig
from rbpf.sensors.readers import open_stereo
from rbpf.sensors.stereo import StereoFeatures, StereoMatcher

NAMES = {"stereo_zed_room1": (1, 5, 10), "stereo_kitti_seq1": (1, 2, 3)}
SLACK_PX, RIGHT = 2.0, 16.3
ELSEWHERE = -2  #: Name of landmarks that are not from the recording.
REACH_PX = 5.0
"""Standard deviation of the predicted pose for gating with a map."""


@dataclass(frozen=True)
class Recording:
    """Features of every pair, and camera poses (T, 7) relative to the first."""

    rig: RectifiedStereo
    features: list[StereoFeatures]
    poses: np.ndarray

    def predicted(self, points: np.ndarray, cov: np.ndarray, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Predicted mean (M, 3) and covariance (M, 3, 3) in the image of world points; NaN if not visible."""
        pose = self.poses[frame]
        local = SE3.inverse_transform(pose, points)
        seen = self.rig.visible(local)
        local = np.where(seen[:, None], local, np.nan)
        slope = self.rig.jacobian(local) @ SE3.rotation(pose).T
        return self.rig.project(local), slope @ cov @ slope.swapaxes(1, 2)

    def in_world(self, frame: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (k, 3) and covariances (k, 3, 3) of features."""
        chosen, turn = self.features[frame].take(rows), SE3.rotation(self.poses[frame])
        return SE3.transform(self.poses[frame], chosen.points), turn @ chosen.cov_points @ turn.T


def read(folder: Path, config: SiftConfig) -> Recording:
    """Reads a whole recording."""
    sequence = open_stereo(folder)
    sensor = StereoMatcher(sequence.rig, Sift(config))
    features = [sensor.measure(frame.image, frame.right) for frame in sequence.frames()]
    return Recording(sequence.rig, features, path(sequence.rig, features)[0])


def shortened(recording: Recording, length: int) -> Recording:
    """The recording with shorter descriptors of the same histograms, whose fractions are squares of "root" descriptors."""
    return replace(
        recording,
        features=[
            replace(f, descriptors=descriptors_from_histograms(f.descriptors**2, length)) for f in recording.features
        ],
    )


def agree(mean: np.ndarray, cov: np.ndarray, z: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Whether predictions (P, 3) and measurements (P, 3) agree."""
    total = cov + noise + SLACK_PX**2 * np.eye(3)
    nu = z - mean
    return np.einsum("pi,pi->p", nu, np.linalg.solve(total, nu[..., None])[..., 0]) <= RIGHT


def frame_to_frame(recording: Recording, gap: int) -> tuple[int, int]:
    """Numbers of matches and of correct ones between pairs `gap` apart."""
    found = right = 0
    for frame in range(0, len(recording.features) - gap, 2):
        before, after = recording.features[frame], recording.features[frame + gap]
        matches = match_all(before.descriptors, after.descriptors, MatchLimits())
        mean, cov = recording.predicted(*recording.in_world(frame, matches.first), frame + gap)
        found += len(matches)
        right += int(agree(mean, cov, after.z[matches.second], after.cov[matches.second]).sum())
    return found, right


@dataclass
class Tally:
    """Matches with a map: their number, the correct ones, and the time taken."""

    found: int = 0
    right: int = 0
    frames: int = 0
    seconds: float = 0.0

    def text(self) -> str:
        return (
            f"{self.found / self.frames:5.1f} {self.right / max(self.found, 1):6.3f} "
            f"{1e3 * self.seconds / self.frames:7.2f} ms"
        )


def with_map(recording: Recording, gated: bool, others: np.ndarray) -> Tally:
    """Matches a recording with a map that grows as in S05, plus descriptors (D, d) from elsewhere."""
    length, tally = recording.features[0].descriptors.shape[1], Tally()
    limits, camera = MatchLimits(), recording.rig.camera
    manager = LandmarkManager(NewLandmarkConfig(), (camera.width, camera.height), length)
    points, covs = np.zeros((0, 3)), np.zeros((0, 3, 3))
    for frame, features in enumerate(recording.features):
        mean, cov = recording.predicted(points, covs, frame)
        seen = manager.names[np.isfinite(mean[manager.names]).all(axis=1)]
        reach = cov[seen] + REACH_PX**2 * np.eye(3)
        held = np.concatenate([others, manager.descriptors])
        start = time.thread_time()
        if gated:
            k, m = gate_pairs(features.z, features.cov, mean[seen], reach, 11.3)
            found = match_pairs(features.descriptors, held, (k, len(others) + manager.rows(seen)[m]), limits)
        else:
            found = match_all(features.descriptors, held, limits)
        tally.seconds += time.thread_time() - start
        ids = np.full(len(features), NULL, dtype=np.int64)
        ids[found.first] = np.append(np.full(len(others), ELSEWHERE), manager.names)[found.second]
        rows = np.flatnonzero(ids >= 0)
        names = ids[rows]
        tally.frames += 1
        tally.found += int((ids != NULL).sum())
        tally.right += int(agree(mean[names], cov[names], features.z[rows], features.cov[rows]).sum())
        manager.observe(names)
        free = np.flatnonzero(ids == NULL)
        descriptors, px = features.descriptors[free], features.z[:, :2]
        nearest = distances(two_best(descriptors, np.concatenate([others, manager.descriptors]))[0])
        new = manager.select(px[free], descriptors, nearest, px[rows])
        manager.add(descriptors[new])
        added = recording.in_world(frame, free[new])
        points, covs = np.concatenate([points, added[0]]), np.concatenate([covs, added[1]])
    return tally


def tables(folder: Path, config: SiftConfig) -> Iterator[str]:
    """Lines of the report."""
    whole = {name: read(folder / name, config) for name in NAMES}
    yield "recording    descriptor  frames apart: matches per pair, fraction that is right"
    for name, gaps in NAMES.items():
        for length in (36, 128):
            recording, cells = shortened(whole[name], length), []
            for gap in gaps:
                found, right = frame_to_frame(recording, gap)
                pairs = len(range(0, len(recording.features) - gap, 2))
                cells.append(f"{gap}: {found / pairs:5.1f} {right / max(found, 1):.3f}")
            yield f"{name:18}  {length:3}  {'   '.join(cells)}"
    yield "recording    descriptor  other descriptors  search: matches per frame, fraction right, time"
    for name, other in (tuple(NAMES), tuple(NAMES)[::-1]):
        for length in (36, 128):
            recording = shortened(whole[name], length)
            foreign = np.concatenate([f.descriptors for f in shortened(whole[other], length).features])
            for count in (0, 1000, 10000):
                others = foreign[:: max(len(foreign) // max(count, 1), 1)][:count]
                cells = [
                    f"{title} {with_map(recording, gated, others).text()}"
                    for title, gated in (("exact", False), ("gated", True))
                ]
                yield f"{name:18}  {length:3}  {len(others):6}      {'   '.join(cells)}"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stereo_descriptors", description=__doc__)
    parser.add_argument("folder", type=Path, help="holds stereo_zed_room1 and stereo_kitti_seq1")
    parser.add_argument("--scale", type=float, default=0.5, help="of the images that SIFT looks at")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for line in tables(arguments.folder, SiftConfig(working_scale=arguments.scale, length=128)):
        print(line, flush=True)


if __name__ == "__main__":
    main()
