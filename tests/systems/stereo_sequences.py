"""Pairs of images of a textured plane, made by homographies: exact poses, and anything may happen to a pair."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.recordings import filter_opened, open_pairs
from rbpf.runs.run import Run
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers import ImageFrame, ImageSequence
from rbpf.sensors.readers.images.sequence import Source
from rbpf.sensors.stereo import StereoFeatures
from rbpf.systems.stereo.config import StereoConfig
from tests.systems.plane_sequences import CAMERA, path, texture, view

BASELINE_M, STEP_NS = 0.12, 66_666_666
Change = Callable[[int, ImageFrame], ImageFrame]


@dataclass(frozen=True)
class Pairs(Source):
    """Both images of each pair; noise differs from image to image."""

    picture: np.ndarray
    poses: np.ndarray
    change: Change

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """From number `start` on."""
        aside = np.array([0.0, 0.0, 0.0, 1.0, BASELINE_M, 0.0, 0.0])
        for t in range(start, len(self.poses)):
            rng, images = np.random.default_rng(t), []
            for pose in (self.poses[t], SE3.compose(self.poses[t], aside)):
                noise = rng.normal(scale=1.5, size=(CAMERA.height, CAMERA.width))
                images.append(np.clip(view(self.picture, pose) + noise, 0, 255).astype(np.uint8))
            yield self.change(t, ImageFrame(t * STEP_NS, *images))


def pairs(count: int, change: Change = lambda t, frame: frame, poses: np.ndarray | None = None) -> ImageSequence:
    """A pair of cameras before the plane."""
    poses = path(2 * count)[::2] if poses is None else poses
    stamps = np.arange(count, dtype=np.int64) * STEP_NS
    truth = Truth(stamps, poses)
    return ImageSequence("plane", CAMERA, stamps, truth, BASELINE_M, Pairs(texture(), poses, change))


def flat(frame: ImageFrame) -> ImageFrame:
    """A pair without texture."""
    grey = np.full((CAMERA.height, CAMERA.width), 100, dtype=np.uint8)
    return ImageFrame(frame.stamp_ns, grey, grey)


def missing(frame: ImageFrame) -> ImageFrame:
    """A pair of which one image cannot be read."""
    return ImageFrame(frame.stamp_ns, frame.image, None, "the right image is missing")


def swapped(frame: ImageFrame) -> ImageFrame:
    """Left for right."""
    return ImageFrame(frame.stamp_ns, frame.right, frame.image)


def filtered(sequence, config: StereoConfig, **options) -> Run:
    """What stereo SLAM says of a sequence; `options` as `filter_opened` has them."""
    return filter_opened(open_pairs(sequence, config), **options)


def errors_m(poses: np.ndarray, sequence: ImageSequence) -> np.ndarray:
    """Of the positions (T,); the first camera is the world."""
    true = SE3.between(sequence.truth.poses[0], sequence.truth.poses[: len(poses)])
    return np.linalg.norm(SE3.translation(poses) - SE3.translation(true), axis=1)


def half_exchanged(rig: RectifiedStereo, features: StereoFeatures) -> StereoFeatures:
    """Half of their places belong to one another."""
    z, rng = features.z.copy(), np.random.default_rng(0)
    rows = rng.permutation(len(z))[: len(z) // 2]
    z[rows] = z[np.roll(rows, 1)]
    rest = features.cov, features.scale, features.orientation, features.descriptors
    return StereoFeatures.measured(rig, z, *rest)
