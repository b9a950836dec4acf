"""A textured room, to take pictures of. The world's z axis points up."""

from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.validation.simulation import textures
from rbpf.validation.simulation.camera_paths import Wave, eased, frame_seconds, looking, shaken
from rbpf.validation.simulation.furniture import Furniture, apart
from rbpf.validation.simulation.limits import check_counts, check_not_negative, check_positive
from rbpf.validation.simulation.textured_scene import TexturedScene, stamps_ns

SHAKE_HZ = 0.3, 1.5

ALONG_M = 0.7
"""What stands along a room's walls stays within this distance of them."""


@dataclass(frozen=True)
class TexturedRoom:
    """A room with pictures on its walls and boxes along them; a camera is carried in a circle and looks outwards.

    The middle of the floor is the origin. Walked anticlockwise from (radius_m, 0).

    Attributes:
        frames: number of images.
        rate_hz: images per second.
        size_m: of the room along x, y and z.
        pictures: number of them on each wall.
        things: most boxes on the floor; as many as find a place.
        radius_m: of the circle.
        eye_m: height of the camera.
        gaze_deg: the camera looks this far outwards from straight ahead.
        drop_deg: and this far down.
        speed_m_s: of walking.
        shake_m: greatest displacement by the hand, per axis.
        shake_deg: greatest rotation by it, per axis.
        start_s: the walk reaches its speed after this time.
        texel_m: side of a texel.
        contrast: of all textures; 1 is rich, 0.1 poor.
    """

    frames: int = 600
    rate_hz: float = 30.0
    size_m: tuple[float, float, float] = (6.0, 5.0, 2.6)
    pictures: int = 5
    things: int = 14
    radius_m: float = 1.0
    eye_m: float = 1.4
    gaze_deg: float = 60.0
    drop_deg: float = 10.0
    speed_m_s: float = 0.4
    shake_m: float = 0.03
    shake_deg: float = 3.0
    start_s: float = 1.0
    texel_m: float = 0.0025
    contrast: float = 1.0

    def __post_init__(self) -> None:
        """Checks that there is something to see, and room to walk."""
        check_counts(self, {"frames": 2, "pictures": 0, "things": 0})
        check_positive(self, "rate_hz", "radius_m", "eye_m", "speed_m_s", "texel_m")
        check_not_negative(self, "shake_m", "shake_deg", "start_s", "contrast")
        floor = 2.0 * (self.radius_m + ALONG_M)
        if not all(np.greater(self.size_m, [floor, floor, self.eye_m]) & np.isfinite(self.size_m)):
            raise InputError(
                f"size_m = {self.size_m} must be more than {floor:g} x {floor:g} m, which the walk takes, and higher "
                f"than eye_m = {self.eye_m}"
            )
        if not (abs(self.drop_deg) < 80.0 and np.isfinite(self.gaze_deg)):
            raise InputError(
                f"drop_deg = {self.drop_deg} must be below 80, and gaze_deg = {self.gaze_deg} a number"
            )

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws the textures, the things and the path."""
        path = self._path(rng)
        half = 0.5 * np.array(self.size_m[:2])
        room = np.array([[*-half, 0.0], [*half, self.size_m[2]]])
        furniture = Furniture(rng, self.texel_m, self.contrast)
        furniture.shell(room, textures.wallpaper, textures.carpet, textures.plaster)
        for wall in range(4):
            for k in range(self.pictures):
                place = ((k + rng.uniform(0.35, 0.65)) / self.pictures, rng.uniform(0.3, 0.55))
                furniture.hang(room, wall, place, rng.uniform(0.35, 0.8, 2).tolist(), textures.picture)
        self._stand(furniture, half, rng)
        stamps = stamps_ns(self.frames, self.rate_hz)
        return TexturedScene("room", stamps, path, furniture.rectangles)

    def _stand(self, furniture: Furniture, half: np.ndarray, rng: np.random.Generator) -> None:
        """Boxes along the walls."""

        def draw() -> tuple[np.ndarray, float]:
            radius = rng.uniform(0.2, 0.5 * ALONG_M)
            place = rng.uniform(-1.0, 1.0, 2) * (half - radius)
            wall = rng.integers(2)
            place[wall] = np.copysign(half[wall] - radius, place[wall])
            return place, radius

        for middle, radius in apart(draw, self.things, []):
            side = radius * np.sqrt(2.0)
            size = (side, side, rng.uniform(0.3, 0.6 * self.size_m[2]))
            foot, yaw = np.array([*middle, 0.0]), rng.uniform(-0.5, 0.5)
            furniture.box(foot, yaw, size, textures.carton, textures.carton)

    def _path(self, rng: np.random.Generator) -> np.ndarray:
        """(T, 7) poses."""
        time = eased(frame_seconds(self.frames, self.rate_hz), self.start_s)
        turn = self.speed_m_s * time / self.radius_m
        level = np.full_like(turn, self.eye_m)
        eye = np.stack([self.radius_m * np.cos(turn), self.radius_m * np.sin(turn), level], axis=-1)
        heading = turn + 0.5 * np.pi - np.deg2rad(self.gaze_deg)
        drop = np.full_like(turn, -np.tan(np.deg2rad(self.drop_deg)))
        bound = [np.deg2rad(self.shake_deg)] * 3 + [self.shake_m] * 3
        direction = np.stack([np.cos(heading), np.sin(heading), drop], axis=-1)
        return shaken(looking(eye, direction), Wave.random(np.array(bound), SHAKE_HZ, rng), time)
