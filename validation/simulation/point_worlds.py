"""Worlds of points for a simulated camera: points that come and go, opaque blocks, the camera's path; a desk of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rbpf.errors import InputError
from rbpf.validation.simulation.limits import (
    check_counts,
    check_fractions,
    check_not_negative,
    check_order,
    check_positive,
)
from rbpf.validation.simulation.paths import Wave, eased, frame_seconds, looking, shaken, slowed

SURFACE = 1e-6
"""Fraction of the line of sight that may lie in a block: a point on a block's face is seen from the front."""

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


def outside(draw: Draw, blocks: np.ndarray) -> Draw:
    """Draws again what falls into a block."""

    def redraw(count: int) -> np.ndarray:
        points = draw(count)
        while True:
            within = (points[:, None] > blocks[:, 0]) & (points[:, None] < blocks[:, 1])
            if not (wrong := within.all(axis=-1).any(axis=-1)).any():
                return points
            points[wrong] = draw(int(wrong.sum()))

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


ARM_HZ = 0.2, 0.8
WRIST_HZ = 0.8, 2.0
"""Before the path is slowed down to the speed of a hand, to about a third."""

TREMOR_HZ = 1.0, 3.0

RISE = 0.25
"""How far the camera goes up and down about the point looked at, as a fraction of how far it goes to the side."""


@dataclass(frozen=True)
class DeskWorld:
    """A camera in a hand moves over a desk and looks at the things on it; it is held still at first.

    The point looked at, the middle of the box at first, wanders over the desk, and the camera about that point. The
    path is slowed down until neither `speed_m_s` nor `turn_rad_s` is passed; the hand's tremor comes on top.

    Attributes:
        frames: number of images.
        rate_hz: images per second.
        points: number of points at any time, uniform in a box with its base on z = 0 and its middle over the origin.
        size_m: of the box along x, y, z.
        nearest_m: least distance of the camera from the point that it looks at.
        farthest_m: greatest distance.
        elevation_deg: the camera looks down at this angle, on the average.
        sweep_deg: greatest turn about the point looked at to either side; a quarter as much up and down.
        wander: greatest shift of the point looked at, as a fraction of the box's size.
        wrist_deg: greatest rotation by the wrist, per axis.
        speed_m_s: highest speed.
        turn_rad_s: highest rate of turn.
        tremor_m: greatest displacement by the hand's tremor, per axis.
        tremor_deg: greatest rotation by it, per axis.
        start_s: the camera reaches its pace after this time.
        blocks: number of opaque things on the desk.
        renewal: fraction of the points that disappear for good per second; others appear elsewhere.
    """

    frames: int = 1000
    rate_hz: float = 30.0
    points: int = 300
    size_m: tuple[float, float, float] = (2.0, 2.0, 1.0)
    nearest_m: float = 1.0
    farthest_m: float = 1.5
    elevation_deg: float = 55.0
    sweep_deg: float = 40.0
    wander: float = 0.3
    wrist_deg: float = 10.0
    speed_m_s: float = 0.3
    turn_rad_s: float = 0.5
    tremor_m: float = 0.002
    tremor_deg: float = 0.3
    start_s: float = 1.0
    blocks: int = 3
    renewal: float = 0.0

    def __post_init__(self) -> None:
        """Checks that there is something to simulate."""
        check_counts(self, {"frames": 2, "points": 1, "blocks": 0})
        check_positive(self, "rate_hz", "nearest_m", "farthest_m", "speed_m_s", "turn_rad_s")
        check_not_negative(self, "sweep_deg", "wander", "wrist_deg", "tremor_m", "tremor_deg", "start_s")
        check_fractions(self, "renewal")
        if not all(0.0 < size < np.inf for size in self.size_m):
            raise InputError(f"size_m must be three positive numbers, got {self.size_m}")
        check_order(self, "nearest_m", "farthest_m")
        steepest = abs(self.elevation_deg) + RISE * self.sweep_deg
        if not steepest < 90.0:
            raise InputError(
                f"elevation_deg = {self.elevation_deg} and sweep_deg = {self.sweep_deg} let the camera look along the "
                "vertical, where it has no upright pose: lessen one of them"
            )

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the points, the blocks and the path."""
        size, half = np.array(self.size_m), np.array(self.size_m) / 2
        extent = size * rng.uniform([0.04, 0.04, 0.1], [0.08, 0.08, 0.25], (self.blocks, 3))
        middle = size * rng.uniform(-0.4, 0.4, (self.blocks, 3))
        middle[:, 2] = extent[:, 2]
        blocks = np.stack([middle - extent, middle + extent], axis=1)
        draw = outside(lambda count: half * [0, 0, 1] + rng.uniform(-half, half, (count, 3)), blocks)
        points, present = populated(draw, self.points, self.frames, self.renewal / self.rate_hz, rng)
        # The path, slowed down, and the tremor on top.
        seconds = frame_seconds(self.frames, self.rate_hz)
        sweep = self._sweep(rng)
        bound = [np.deg2rad(self.tremor_deg)] * 3 + [self.tremor_m] * 3
        tremor = Wave.random(np.array(bound), TREMOR_HZ, rng)
        time = eased(seconds, self.start_s)
        path = shaken(slowed(sweep, seconds, self.speed_m_s, self.turn_rad_s)(time), tremor, time)
        return Scene("desk", frame_stamps(self.frames, self.rate_hz), path, points, present, blocks)

    def _sweep(self, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
        """Poses (T, 7) at times (T,), faster than a hand."""
        turn = np.deg2rad(self.sweep_deg) * np.array([1.0, RISE])
        reach = 0.5 * (self.farthest_m - self.nearest_m)
        arm = Wave.random(np.array([*(0.5 * self.wander * np.array(self.size_m)), *turn, reach]), ARM_HZ, rng)
        start = arm(np.zeros(1))[:, :3] - [0.0, 0.0, 0.5 * self.size_m[2]]
        wrist = Wave.random(np.deg2rad([self.wrist_deg] * 3 + [0.0] * 3), WRIST_HZ, rng)

        def sweep(time: np.ndarray) -> np.ndarray:
            wave = arm(time)
            side, rise = wave[:, 3], np.deg2rad(self.elevation_deg) + wave[:, 4]
            away = np.stack(
                [np.sin(side) * np.cos(rise), -np.cos(side) * np.cos(rise), np.sin(rise)], axis=-1
            )
            distance = 0.5 * (self.nearest_m + self.farthest_m) + wave[:, 5:]
            target = wave[:, :3] - start
            return shaken(looking(target + distance * away, -away), wrist, time)

        return sweep
