"""Cost and accuracy of settings of stereo SIFT: python -m benchmarks.stereo_settings FOLDER_OF_RECORDINGS.

For each setting: processor time per image pair on one thread, features, inliers of the motion between consecutive
pairs, and the error of a plain odometry's path (`plain_odometry`; no filter, no map).
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.plain_odometry import path
from rbpf.lie import SE3
from rbpf.runs.trajectory import align
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.features import Sift, SiftConfig
from rbpf.sensors.readers import ImageSequence, open_stereo
from rbpf.sensors.stereo import PairConfig, StereoFeatures, StereoMatcher

NAMES = "stereo_zed_room1", "stereo_kitti_seq1"
SEEDS = 3

SETTINGS = {
    "whole image": (SiftConfig(features=0, working_scale=1.0), PairConfig()),
    "half": (SiftConfig(features=0), PairConfig()),
    "half, not refined": (SiftConfig(features=0), PairConfig(refine=False)),
    "half, descriptors of 128": (SiftConfig(features=0, length=128), PairConfig()),
    "half, contrast 0.02": (SiftConfig(features=0, contrast=0.02), PairConfig()),
    "half, 300 keypoints": (SiftConfig(features=300), PairConfig()),
    "0.35": (SiftConfig(features=0, working_scale=0.35), PairConfig()),
}


def measured(sequence: ImageSequence, sensor: StereoMatcher) -> tuple[list[StereoFeatures], np.ndarray]:
    """Features of all pairs, and mean milliseconds of SIFT and of matching."""
    features, seconds = [], np.zeros(2)
    for frame in sequence.frames():
        start = time.process_time()
        keypoints = sensor.extractor.extract(frame.image), sensor.extractor.extract(frame.right)
        middle = time.process_time()
        features.append(sensor.match((frame.image, frame.right), *keypoints))
        seconds += middle - start, time.process_time() - middle
    return features, 1e3 * seconds / len(sequence)


def errors(rig: RectifiedStereo, features: list[StereoFeatures], truth: np.ndarray) -> tuple[float, ...]:
    """Medians over seeds: ATE after rigid and after similarity alignment [m], scale, inliers."""
    rows = []
    for seed in range(SEEDS):
        poses, agreeing = path(rig, features, seed)
        place, reference, row = SE3.translation(poses), SE3.translation(truth), []
        for with_scale in (False, True):
            fitted = align(place, reference, with_scale)
            miss = fitted.transform(place) - reference
            row.append(float(np.sqrt(np.square(miss).sum(axis=1).mean())))
        rows.append((*row, fitted.scale, agreeing))
    return tuple(np.median(rows, axis=0))


def lines(folder: Path, names: list[str]) -> Iterator[str]:
    """Lines of the report."""
    yield "recording           setting                      SIFT   match ms  features  agree  ATE rigid   sim3  scale"
    for name in names:
        sequence = open_stereo(folder / name)
        truth = sequence.truth
        assert truth is not None
        rows = np.abs(truth.stamps_ns[None] - sequence.stamps_ns[:, None]).argmin(axis=1)
        for title, (sift, stereo) in SETTINGS.items():
            features, ms = measured(sequence, StereoMatcher(sequence.rig, Sift(sift), stereo))
            rigid, similar, scale, agreeing = errors(sequence.rig, features, truth.poses[rows])
            count = np.mean([len(each) for each in features])
            cells = f"{ms[0]:7.1f} {ms[1]:7.1f}  {count:8.0f} {agreeing:6.0f}     {rigid:.4f} {similar:.4f} {scale:.4f}"
            yield f"{name:18}  {title:26} {cells}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stereo_settings", description=__doc__)
    parser.add_argument("folder", type=Path, help="holds the recordings")
    parser.add_argument("names", nargs="*", default=list(NAMES), help=f"by default {' '.join(NAMES)}")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for line in lines(arguments.folder, arguments.names):
        print(line, flush=True)


if __name__ == "__main__":
    main()
