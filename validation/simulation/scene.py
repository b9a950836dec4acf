"""What a simulated camera looks at: points that come and go, opaque blocks, and the camera's path."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

SURFACE = 1e-6
"""Share of the line of sight that may lie in a block: a point on a block's face is seen from the front."""

Draw = Callable[[int], np.ndarray]
"""Draws that many positions (K, 3) in the world."""


@dataclass(frozen=True)
class Scene:
    """A world with everything random about it drawn.

    Attributes:
        name: of the world.
        stamps_ns: (T,) int64 times of the frames.
        world_from_camera: (T, 7) true poses at these times.
        points: (Q, 3) in the world, m.
        present: (Q, 2) int64, the frame in which a point appears and the one in which it is gone for good.
        blocks: (B, 2, 3) least and greatest corner of opaque boxes, m.
    """

    name: str
    stamps_ns: np.ndarray
    world_from_camera: np.ndarray
    points: np.ndarray
    present: np.ndarray
    blocks: np.ndarray


class PointWorld(Protocol):
    """What can be simulated."""

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws everything random about the world."""
        ...


def frame_stamps(frames: int, rate_hz: float) -> np.ndarray:
    """(T,) int64 nanoseconds of the frames, the first at 0."""
    return np.round(np.arange(frames) * 1e9 / rate_hz).astype(np.int64)


def hidden(eye: np.ndarray, points: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Whether a block stands between the eye (3,) and points (P, 3), by the slab method; (P,) bool."""
    around = np.concatenate([eye[None], points])
    near = (blocks[:, 0] <= around.max(axis=0)) & (blocks[:, 1] >= around.min(axis=0))
    low, high = np.moveaxis(blocks[near.all(axis=1)] - eye, 1, 0)
    enters, leaves = np.full((2, len(points), len(low)), [[[-np.inf]], [[np.inf]]])
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(3):
            ray = (points[:, axis] - eye[axis])[:, None]
            ends = low[:, axis] / ray, high[:, axis] / ray
            np.maximum(enters, np.minimum(*ends), out=enters)
            np.minimum(leaves, np.maximum(*ends), out=leaves)
    return np.asarray(((enters < leaves) & (leaves > 0.0) & (enters < 1.0 - SURFACE)).any(axis=-1))


def inside(points: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Whether points (P, 3) lie within a block; (P,) bool."""
    within = (points[:, None] > blocks[:, 0]) & (points[:, None] < blocks[:, 1])
    return np.asarray(within.all(axis=-1).any(axis=-1))


def outside(draw: Draw, blocks: np.ndarray) -> Draw:
    """Draws again what falls into a block."""

    def redraw(count: int) -> np.ndarray:
        points = draw(count)
        while (wrong := inside(points, blocks)).any():
            points[wrong] = draw(int(wrong.sum()))
        return points

    return redraw


def populated(
    draw: Draw, count: int, frames: int, renewal: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points of which one appears elsewhere whenever one disappears for good.

    Args:
        draw: the places.
        count: of points at any time.
        frames: of the recording.
        renewal: probability per frame that a point disappears.
        rng: generator.

    Returns:
        Positions (Q, 3) and frames (Q, 2), as in `Scene`; the first `count` are there in the first frame.
    """
    points, present = [], []
    start = np.zeros(count, dtype=np.int64)
    while start.size:
        life = rng.geometric(renewal, start.size) if renewal > 0.0 else frames
        end = np.minimum(start + life, frames)
        points.append(draw(start.size))
        present.append(np.stack([start, end], axis=-1))
        start = end[end < frames]
    return np.concatenate(points), np.concatenate(present)


def face_areas(box: np.ndarray, faces: list[tuple[int, int]]) -> np.ndarray:
    """(F,) areas of faces, as `on_faces` takes them, m²."""
    size = box[1] - box[0]
    return np.prod(size) / size[[axis for axis, _ in faces]]


def on_faces(
    box: np.ndarray, faces: list[tuple[int, int]], count: int, rng: np.random.Generator
) -> np.ndarray:
    """Positions (K, 3), uniform by area on faces of a box.

    Args:
        box: (2, 3) least and greatest corner.
        faces: (axis, 0 for the least or 1 for the greatest side).
        count: K.
        rng: generator.
    """
    axis, side = np.array(faces).T
    area = face_areas(box, faces)
    face = rng.choice(len(faces), count, p=area / area.sum())
    points = rng.uniform(box[0], box[1], (count, 3))
    points[np.arange(count), axis[face]] = box[side[face], axis[face]]
    return points
