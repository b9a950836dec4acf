"""Worlds that a person with a camera walks through: a loop round the core of a building, and a long corridor.

The world's z axis points up; the floor is z = 0.
"""

from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.validation.simulation.camera_paths import Wave, eased, frame_seconds, looking, shaken
from rbpf.validation.simulation.limits import (
    check_counts,
    check_fractions,
    check_not_negative,
    check_positive,
)
from rbpf.validation.simulation.scene import Scene, face_areas, frame_stamps, on_faces, outside, populated

SHAKE_HZ = 0.3, 1.5
GLANCE_HZ = 0.05, 0.2

SIDES = [(0, 0), (0, 1), (1, 0), (1, 1)]
ALL = [*SIDES, (2, 0), (2, 1)]
AHEAD = ALL[1:]
"""Faces of a room: its four walls, with floor and ceiling, and those that are seen on the way along a corridor."""

CLEAR_M, DEEP_M = 0.5, 0.5
"""Furniture keeps the first distance from the line that is walked, and reaches at most the second into the room."""

END_M = 1.0
"""The walk along a corridor keeps this distance from both ends."""


@dataclass(frozen=True)
class LoopWorld:
    """A camera is carried in a circle through the aisle round the core of a building, and on past its start.

    The core, a square block, hides the other side. The points are on its walls and on the outer walls, the floor and
    the ceiling. Walked anticlockwise from (radius_m, 0).

    Attributes:
        frames: number of images.
        rate_hz: images per second.
        points: number of points at any time.
        radius_m: of the circle.
        aisle_m: width of the aisle at its narrowest.
        height_m: of the walls.
        eye_m: height of the camera.
        speed_m_s: of walking.
        gaze_deg: the camera looks this far inwards from straight ahead; outwards if negative.
        shake_m: greatest displacement by the hand, per axis.
        shake_deg: greatest rotation by it, per axis.
        start_s: the walk reaches its speed after this time.
        blocks: number of opaque pieces of furniture at the outer walls.
        renewal: fraction of the points that disappear for good per second; others appear elsewhere.
    """

    frames: int = 1200
    rate_hz: float = 30.0
    points: int = 900
    radius_m: float = 3.0
    aisle_m: float = 2.4
    height_m: float = 2.5
    eye_m: float = 1.5
    speed_m_s: float = 0.6
    gaze_deg: float = 20.0
    shake_m: float = 0.03
    shake_deg: float = 3.0
    start_s: float = 1.0
    blocks: int = 4
    renewal: float = 0.0

    def __post_init__(self) -> None:
        """Checks that there is something to simulate."""
        _check_walk(self)
        check_positive(self, "radius_m")
        _check_aisle("aisle_m", self.aisle_m)
        if not self.aisle_m < 2.0 * self.radius_m:
            raise InputError(f"aisle_m = {self.aisle_m} must be less than twice radius_m = {self.radius_m}")

    @property
    def laps(self) -> float:
        """How many times round."""
        seconds = frame_seconds(self.frames, self.rate_hz)[-1:]
        return self.speed_m_s * eased(seconds, self.start_s).item() / (2.0 * np.pi * self.radius_m)

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the points, the furniture and the path."""
        core, room = self._square(self._core), self._square(self._room)
        blocks = np.concatenate([core[None], self._furniture(rng)])
        fraction = face_areas(core, SIDES).sum() / (
            face_areas(core, SIDES).sum() + face_areas(room, ALL).sum()
        )

        def draw(count: int) -> np.ndarray:
            near = int(rng.binomial(count, fraction))
            walls = on_faces(core, SIDES, near, rng), on_faces(room, ALL, count - near, rng)
            return rng.permutation(np.concatenate(walls))

        chance = self.renewal / self.rate_hz
        points, present = populated(outside(draw, blocks), self.points, self.frames, chance, rng)
        stamps = frame_stamps(self.frames, self.rate_hz)
        return Scene("loop", stamps, self._path(rng), points, present, blocks)

    @property
    def _core(self) -> float:
        """Half of the core's side: its corners are half an aisle from the circle."""
        return (self.radius_m - 0.5 * self.aisle_m) / np.sqrt(2.0)

    @property
    def _room(self) -> float:
        """Half of the outer walls' length."""
        return self.radius_m + 0.5 * self.aisle_m

    def _square(self, half: float) -> np.ndarray:
        """(2, 3) least and greatest corner of the block round the middle."""
        return np.array([[-half, -half, 0.0], [half, half, self.height_m]])

    def _furniture(self, rng: np.random.Generator) -> np.ndarray:
        """(B, 2, 3) blocks at the outer walls."""
        room = self._square(self._room)
        foot = on_faces(room, SIDES, self.blocks, rng)
        return _furniture(foot, 0.5 * self.aisle_m - CLEAR_M, room, rng)

    def _path(self, rng: np.random.Generator) -> np.ndarray:
        """(T, 7) poses."""
        time = eased(frame_seconds(self.frames, self.rate_hz), self.start_s)
        turn = self.speed_m_s * time / self.radius_m
        eye = np.stack(
            [self.radius_m * np.cos(turn), self.radius_m * np.sin(turn), np.full_like(turn, self.eye_m)],
            axis=-1,
        )
        heading = turn + 0.5 * np.pi + np.deg2rad(self.gaze_deg)
        direction = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(turn)], axis=-1)
        return shaken(looking(eye, direction), _shake(self, rng), time)


@dataclass(frozen=True)
class CorridorWorld:
    """A camera is carried along a straight corridor: points come into view and leave it for ever.

    The corridor runs along x from 0, with y = 0 in its middle. The points are on the walls, the floor, the ceiling and
    the far end.

    Attributes:
        frames: number of images.
        rate_hz: images per second.
        points: number of points at any time.
        length_m: of the corridor.
        width_m: of it.
        height_m: of it.
        eye_m: height of the camera.
        speed_m_s: of walking; starts 1 m from one end, and must stop 1 m before the other.
        glance_deg: greatest slow turn of the gaze to either side.
        shake_m: greatest displacement by the hand, per axis.
        shake_deg: greatest rotation by it, per axis.
        start_s: the walk reaches its speed after this time.
        blocks: number of opaque pieces of furniture at the walls.
        renewal: fraction of the points that disappear for good per second; others appear elsewhere.
    """

    frames: int = 1000
    rate_hz: float = 30.0
    points: int = 1200
    length_m: float = 30.0
    width_m: float = 2.0
    height_m: float = 2.5
    eye_m: float = 1.5
    speed_m_s: float = 0.8
    glance_deg: float = 15.0
    shake_m: float = 0.03
    shake_deg: float = 3.0
    start_s: float = 1.0
    blocks: int = 6
    renewal: float = 0.0

    def __post_init__(self) -> None:
        """Checks that there is something to simulate, and that the corridor is long enough."""
        _check_walk(self)
        check_positive(self, "length_m")
        check_not_negative(self, "glance_deg")
        _check_aisle("width_m", self.width_m)
        end = END_M + self.speed_m_s * self._time()[-1]
        if end > self.length_m - END_M:
            raise InputError(
                f"the camera would walk to {end:.1f} m, but must stop {END_M:.0f} m before the end of a corridor of "
                f"{self.length_m} m: simulate fewer frames, less speed or a longer corridor"
            )

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the points, the furniture and the path."""
        side = 0.5 * self.width_m
        room = np.array([[0.0, -side, 0.0], [self.length_m, side, self.height_m]])
        foot = on_faces(room, [(1, 0), (1, 1)], self.blocks, rng)
        blocks = _furniture(foot, side - CLEAR_M, room, rng)
        draw = outside(lambda count: on_faces(room, AHEAD, count, rng), blocks)
        chance = self.renewal / self.rate_hz
        points, present = populated(draw, self.points, self.frames, chance, rng)
        stamps = frame_stamps(self.frames, self.rate_hz)
        return Scene("corridor", stamps, self._path(rng), points, present, blocks)

    def _time(self) -> np.ndarray:
        """(T,) time of walking at full speed."""
        return eased(frame_seconds(self.frames, self.rate_hz), self.start_s)

    def _path(self, rng: np.random.Generator) -> np.ndarray:
        """(T, 7) poses."""
        time = self._time()
        still = np.zeros_like(time)
        eye = np.stack([END_M + self.speed_m_s * time, still, still + self.eye_m], axis=-1)
        heading = Wave.random(np.deg2rad([self.glance_deg]), GLANCE_HZ, rng)(time)[:, 0]
        direction = np.stack([np.cos(heading), np.sin(heading), still], axis=-1)
        return shaken(looking(eye, direction), _shake(self, rng), time)


def _check_walk(world: LoopWorld | CorridorWorld) -> None:
    check_counts(world, {"frames": 2, "points": 1, "blocks": 0})
    check_positive(world, "rate_hz", "height_m", "speed_m_s")
    check_not_negative(world, "shake_m", "shake_deg", "start_s")
    check_fractions(world, "renewal")
    if not 0.0 < world.eye_m < world.height_m:
        raise InputError(f"eye_m = {world.eye_m} must be between the floor and height_m = {world.height_m}")


def _check_aisle(name: str, width_m: float) -> None:
    if not (width_m > 2.0 * CLEAR_M and np.isfinite(width_m)):
        raise InputError(f"{name} must be more than {2.0 * CLEAR_M:g} m, so that one can walk, got {width_m}")


def _furniture(foot: np.ndarray, deep_m: float, room: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(B, 2, 3) blocks on the floor, each up to `deep_m` round a place (B, 3) at a wall and within the room (2, 3)."""
    half = rng.uniform(0.4, 1.0, (len(foot), 3)) * min(deep_m, DEEP_M)
    blocks = np.stack([foot - half, foot + half], axis=1)
    blocks[:, 0, 2] = 0.0
    blocks[:, 1, 2] = room[1, 2] * rng.uniform(0.3, 0.8, len(foot))
    return np.clip(blocks, *room)


def _shake(world: LoopWorld | CorridorWorld, rng: np.random.Generator) -> Wave:
    """Of the hand, six channels."""
    bound = [np.deg2rad(world.shake_deg)] * 3 + [world.shake_m] * 3
    return Wave.random(np.array(bound), SHAKE_HZ, rng)
