"""Image sequences of a textured plane, made by homographies: exact poses, and anything may happen to the images."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import ImageFrame, ImageSequence, KnownPixels
from rbpf.sensors.readers.images.sequence import Source
from rbpf.systems.mono.known_map import KnownMap

CAMERA = Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
TEXEL_M, DEPTH_M, TILT = 0.004, 1.5, 0.35


@cache
def texture(seed: int = 0, size: int = 1000) -> np.ndarray:
    """Blobs of all sizes, grey; not to be written to."""
    rng, total = np.random.default_rng(seed), np.zeros((size, size))
    for sigma in (1.5, 3.0, 6.0, 12.0):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), sigma)
        total += layer / layer.std()
    picture = np.clip(128.0 + 30.0 * total, 0, 255).astype(np.uint8)
    picture.flags.writeable = False
    return picture


def on_plane(texels: np.ndarray) -> np.ndarray:
    """World points (…, 3) of places (…, 2) of the texture: a wall that leans away."""
    side, down = (np.moveaxis(texels, -1, 0) - 500.0) * TEXEL_M
    return np.stack([side, down * np.cos(TILT), DEPTH_M + down * np.sin(TILT) + 0.3 * side], axis=-1)


def view(picture: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """What the camera sees of the plane."""
    corners = np.array([[0.0, 0.0], [999.0, 0.0], [999.0, 999.0], [0.0, 999.0]])
    px = CAMERA.project(SE3.inverse_transform(world_from_camera, on_plane(corners)))
    homography = cv2.getPerspectiveTransform(corners.astype(np.float32), px.astype(np.float32))
    return cv2.warpPerspective(picture, homography, (CAMERA.width, CAMERA.height), flags=cv2.INTER_AREA)


def shown_at(px: np.ndarray) -> np.ndarray:
    """Points (K, 3) of the plane that the first image shows at pixels (K, 2)."""
    rays = np.concatenate([CAMERA.unproject(px), np.ones((len(px), 1))], axis=-1)
    corner, side, down = on_plane(np.array([[500.0, 500.0], [501.0, 500.0], [500.0, 501.0]]))
    normal = np.cross(side - corner, down - corner)
    return rays * (normal @ corner / (rays @ normal))[:, None]


def path(frames: int) -> np.ndarray:
    """Poses (T, 7): about ten centimetres to and fro in two seconds, and a little turning."""
    t = np.arange(frames) / 30.0
    zero = np.zeros_like(t)
    turn = np.stack([0.05 * np.sin(2.0 * t), 0.06 * np.sin(1.5 * t), 0.1 * np.sin(t)], axis=-1)
    shift = np.stack([0.25 * np.sin(1.5 * t), 0.1 * np.sin(2.2 * t), 0.1 * np.sin(1.1 * t) + zero], axis=-1)
    return SE3.retract(SE3.identity(), np.concatenate([turn, shift], axis=-1))


@dataclass(frozen=True)
class Pictures(Source):
    """Images of the plane, changed by a function of frame number and image; noise differs from frame to frame."""

    picture: np.ndarray
    poses: np.ndarray
    change: Callable[[int, np.ndarray], np.ndarray | None]

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """From number `start` on."""
        for t in range(start, len(self.poses)):
            noise = np.random.default_rng(t).normal(scale=1.5, size=(CAMERA.height, CAMERA.width))
            image = np.clip(view(self.picture, self.poses[t]) + noise, 0, 255).astype(np.uint8)
            yield ImageFrame(t * 33_333_333, self.change(t, image))


def sequence(
    frames: int, change: Callable[[int, np.ndarray], np.ndarray | None] = lambda t, image: image
) -> ImageSequence:
    """A camera before the plane."""
    stamps = np.arange(frames, dtype=np.int64) * 33_333_333
    return ImageSequence("plane", CAMERA, stamps, None, None, Pictures(texture(), path(frames), change))


def known_points() -> KnownPixels:
    """Eight points of the plane that the first image shows."""
    px = np.array([[60, 50], [250, 60], [70, 190], [240, 180], [160, 120], [110, 100], [200, 70], [150, 200]], float)
    return KnownPixels(np.arange(len(px)), px, shown_at(px), np.full(len(px), 0.002 * np.sqrt(3.0)))  # 2 mm per axis


def made_up_map(count: int = 12) -> KnownMap:
    """The map of an earlier run that there never was."""
    rng = np.random.default_rng(0)
    return KnownMap(
        CAMERA, "none", np.arange(count), rng.normal(size=(count, 3)), np.tile(0.01 * np.eye(3), (count, 1, 1)),
        rng.integers(0, 256, (count, 31, 31), dtype=np.uint8), rng.uniform(0, 200, (count, 2)),
        np.tile(SE3.identity(), (count, 1)), np.tile(SE3.identity(), (3, 1)),
    )  # fmt: skip
