"""Noise of stereo features by scale: python -m benchmarks.stereo_noise FOLDER_OF_RECORDINGS.

Residuals of features in consecutive pairs that agree with one motion (`plain_odometry`): robust standard deviations of
the position, per axis, and of the disparity, divided by √2 for the two pairs. For the recordings, and for a rendered
room.
"""

import argparse
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.plain_odometry import WITHIN_PX, motion
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.descriptors import MatchLimits, match_all
from rbpf.sensors.readers import ImageSequence, open_stereo
from rbpf.sensors.stereo import StereoMatcher
from rbpf.validation.simulation.desk_and_room import TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images

NAMES = "stereo_zed_room1", "stereo_kitti_seq1"
BOUNDS = 0.0, 2.0, 3.0, 4.5, 7.0, 12.0, np.inf
FRAMES = 40


def residuals(sequence: ImageSequence) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (P, 3) of (u_left, v, u_right), px, and scales (P,)."""
    sensor, misses, scales = StereoMatcher(sequence.rig), [], []
    frames = [frame for frame, _ in zip(sequence.frames(), range(FRAMES), strict=False)]
    features = [sensor.measure(frame.image, frame.right) for frame in frames]
    for before, after in pairwise(features):
        matches = match_all(before.descriptors, after.descriptors, MatchLimits())
        first, second = before.take(matches.first), after.take(matches.second)
        pose, _ = motion(sequence.rig, first, second)
        miss = second.z - sequence.rig.project(SE3.transform(pose, first.points))
        near = np.linalg.norm(miss[:, :2], axis=1) <= WITHIN_PX
        misses.append(miss[near])
        scales.append(second.scale[near])
    return np.concatenate(misses), np.concatenate(scales)


def deviation(values: np.ndarray) -> float:
    """Robust standard deviation per pair, of differences of two."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))) / np.sqrt(2.0))


def lines(sequence: ImageSequence, name: str) -> Iterator[str]:
    """One line per range of scales."""
    miss, scale = residuals(sequence)
    for low, high in pairwise(BOUNDS):
        part = miss[(scale >= low) & (scale < high)]
        if len(part) >= 20:
            u, v, disparity = map(deviation, (part[:, 0], part[:, 1], part[:, 0] - part[:, 2]))
            yield f"{name:18} {low:4g}-{high:<4g} {len(part):5} {u:7.3f} {v:7.3f} {disparity:7.3f}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stereo_noise", description=__doc__)
    parser.add_argument("folder", type=Path, help="holds stereo_zed_room1 and stereo_kitti_seq1")
    folder = parser.parse_args().folder
    print("recording           scale  count       u       v  disparity, px")
    with TemporaryDirectory() as scratch:
        room = Path(scratch) / "room"
        rig = RectifiedStereo(Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5), 0.12)
        simulate_images(TexturedRoom(frames=FRAMES, rate_hz=10.0), Imaging(known=0), rig, room, 0)
        for name, path in [("rendered room", room), *((name, folder / name) for name in NAMES)]:
            for line in lines(open_stereo(path), name):
                print(line, flush=True)


if __name__ == "__main__":
    main()
