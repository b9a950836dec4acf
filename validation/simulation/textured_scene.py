"""Scenes for a simulated camera: flat textured rectangles in space, and the camera's path.

A world is any object with `build(rng) -> TexturedScene`. A custom one, a picture on a wall that a camera passes:

    >>> import numpy as np
    >>> from rbpf.lie import SE3
    >>> from rbpf.validation.simulation.textures import picture
    >>> class Gallery:
    ...     def build(self, rng):
    ...         paint = picture((400, 800), rng)
    ...         wall = Rectangle(np.array([-2.0, -1.0, 3.0]), np.array([4.0, 0, 0]), np.array([0, 2.0, 0]), paint)
    ...         path = np.tile(SE3.identity(), (60, 1))
    ...         path[:, 4] = np.linspace(-0.5, 0.5, 60)
    ...         stamps = stamps_ns(60, 30.0)
    ...         return TexturedScene("gallery", stamps, path, [wall])
    >>> len(Gallery().build(np.random.default_rng(0)).rectangles)
    1
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.ranges import NotNegative, check_ranges
from rbpf.sensors.calibration import Board
from rbpf.validation.simulation.textures import Paint, chessboard, faded

#: Stamp of the first image: all stamps have equally many digits, so that file names sort by time.
EPOCH_NS = 1_400_000_000_000_000_000


@dataclass(frozen=True)
class Rectangle:
    """A flat textured rectangle, visible from both sides; from the front its texture appears as stored.

    The centre of texel (row i, column j) of a texture (H, W) lies at corner + (j + ½)/W across + (i + ½)/H down.

    Raises InputError: the sides span no area, the texture is no grey image, or the gain is negative.
    """

    corner: np.ndarray  #: (3,) position of the texture's top left corner in the world, m.
    across: np.ndarray  #: (3,) from there to the top right corner, m.
    #: (3,) from there to the bottom left corner, m; not parallel to `across`, nor need it be perpendicular.
    down: np.ndarray
    texture: np.ndarray  #: (H, W) uint8 grey levels, at least 2 × 2.
    gain: NotNegative = 1.0  #: illumination, a factor on the grey levels.

    def __post_init__(self) -> None:
        sides = np.array([self.corner, self.across, self.down], dtype=float)
        if sides.shape != (3, 3) or not np.isfinite(sides).all() or not np.cross(*sides[1:]).any():
            raise InputError(
                "a rectangle needs a corner and two sides of three finite numbers each that span an area, got "
                f"corner {self.corner}, across {self.across}, down {self.down}"
            )
        texture = self.texture
        if texture.dtype != np.uint8 or texture.ndim != 2 or min(texture.shape) < 2:
            raise InputError(
                f"a texture must be a grey image of uint8, at least 2 x 2, got shape {texture.shape} of {texture.dtype}"
            )
        check_ranges(self)


@dataclass(frozen=True)
class TexturedScene:
    """A realisation of a world."""

    name: str  #: of the world.
    stamps_ns: np.ndarray  #: (T,) int64 times of the frames, ascending.
    world_from_camera: np.ndarray  #: (T, 7) true poses at these times, the centres of the exposures.
    rectangles: Sequence[Rectangle]  #: the visible surfaces.
    #: chessboards and their poses world_from_board (7,): the first inner corner, x across, y down, z into the board.
    boards: Sequence[tuple[Board, np.ndarray]] = ()


class ImageWorld(Protocol):
    """A random world for a simulated camera."""

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws a realisation of the world."""
        ...


def stamps_ns(frames: int, rate_hz: float) -> np.ndarray:
    """(T,) int64 nanoseconds of the frames, the first at `EPOCH_NS`."""
    return EPOCH_NS + np.round(np.arange(frames) * 1e9 / rate_hz).astype(np.int64)


def sides(rectangles: Sequence[Rectangle]) -> np.ndarray:
    """(R, 3, 3) across, down and corner of rectangles, in the world."""
    return np.array([[r.across, r.down, r.corner] for r in rectangles], dtype=float).reshape(-1, 3, 3)


def rays_to_sides(sides: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """H (R, 3, 3): a ray (u, v, 1) hits a rectangle at (s, t, 1)/z = H (u, v, 1); 0 if the camera is in its plane."""
    rotation = SE3.matrix(world_from_camera)[:3, :3]
    seen_from = np.zeros((3, 3))
    seen_from[2] = world_from_camera[4:]
    m = np.swapaxes((sides - seen_from) @ rotation, 1, 2)
    flat = np.abs(np.linalg.det(m)) < np.finfo(float).tiny
    m[flat] = np.eye(3)
    return np.where(flat[:, None, None], 0.0, np.linalg.inv(m))


def cast(rectangles: Sequence[Rectangle], world_from_camera: Array, uv: Array) -> tuple[np.ndarray, np.ndarray]:
    """First hits of single rays (u, v) (K, 2), as `Renderer.depth` for a few pixels.

    Returns depth z (K,) in the camera's frame [m] and row (K,) of the rectangle; infinite and -1 without a hit.
    """
    ray = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    s, t, w = np.moveaxis(rays_to_sides(sides(rectangles), world_from_camera) @ ray.T, 1, 0)
    with np.errstate(invalid="ignore"):
        hit = (w > 0.0) & (s >= 0.0) & (s <= w) & (t >= 0.0) & (t <= w)
    nearest = np.where(hit, w, 0.0)
    row = nearest.argmax(axis=0)
    inverse = nearest[row, np.arange(len(uv))]
    with np.errstate(divide="ignore"):
        return 1.0 / inverse, np.where(inverse > 0.0, row, -1)


LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])  #: Direction to the light source.
DIRECT = 0.25  #: Fraction of directional light; the rest is ambient.
MOST_TRIES = 1000  #: Maximum number of places drawn for objects that do not overlap.
BOARD_TEXELS = 40  #: Texels per square of a chessboard; its white margin is one square wide.


class Furniture:
    """Collects rectangles, each with its own texture: `texel_m` is the side of a texel, `contrast` a factor."""

    def __init__(self, rng: np.random.Generator, texel_m: float, contrast: float) -> None:
        self.rectangles: list[Rectangle] = []
        self._rng, self._texel_m, self._contrast = rng, texel_m, contrast

    def sheet(self, corner: np.ndarray, across: np.ndarray, down: np.ndarray, paint: Paint) -> None:
        """Adds an illuminated rectangle."""
        shape = [max(8, round(float(np.linalg.norm(side)) / self._texel_m)) for side in (down, across)]
        texture = faded(paint((shape[0], shape[1]), self._rng), self._contrast)
        self.rectangles.append(Rectangle(corner, across, down, texture, _gain(across, down)))

    def flat(self, middle: np.ndarray, yaw: float, size: Sequence[float], paint: Paint) -> None:
        """Adds a horizontal sheet (width, length) centred at (3,)."""
        across, up = size[0] * _heading(yaw), size[1] * _heading(yaw + 0.5 * np.pi)
        self.sheet(middle - 0.5 * across + 0.5 * up, across, -up, paint)

    def box(self, foot: np.ndarray, yaw: float, size: Sequence[float], top: Paint, side: Paint) -> None:
        """Adds a box (width, length, height) whose base is centred at (3,)."""
        x, y = 0.5 * size[0] * _heading(yaw), 0.5 * size[1] * _heading(yaw + 0.5 * np.pi)
        height = np.array([0.0, 0.0, size[2]])
        ring = [foot + height + corner for corner in (-x - y, x - y, x + y, y - x)]
        for left, right in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self.sheet(left, right - left, -height, side)
        self.sheet(ring[3], 2.0 * x, -2.0 * y, top)

    def shell(self, room: np.ndarray, wall: Paint, floor: Paint, ceiling: Paint) -> None:
        """Adds walls, floor and ceiling of a room (2, 3), its least and greatest corner, facing inwards."""
        (x0, y0, z0), (x1, y1, z1) = room
        height = np.array([0.0, 0.0, z1 - z0])
        ring = np.array([[x0, y1, z1], [x1, y1, z1], [x1, y0, z1], [x0, y0, z1]])
        for left, right in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self.sheet(left, right - left, -height, wall)
        self.sheet(ring[0] - height, ring[1] - ring[0], ring[3] - ring[0], floor)
        self.sheet(ring[3], ring[2] - ring[3], ring[0] - ring[3], ceiling)

    def hang(self, room: np.ndarray, wall: int, place: Sequence[float], size: Sequence[float], paint: Paint) -> None:
        """Adds a picture (width, height) [m] on a wall of a room (2, 3), its least and greatest corner.

        Walls 0 to 3 are those at the greatest y and x, then at the least y and x; `place` is the picture's centre, as
        fractions of the wall from the left and from the top.
        """
        (x0, y0, z0), (x1, y1, z1) = room
        left, right = np.roll(np.array([[x0, y1], [x1, y1], [x1, y0], [x0, y0]]), -wall, axis=0)[:2]
        along = (right - left) / np.linalg.norm(right - left)
        middle = left + place[0] * (right - left) + 0.01 * np.array([along[1], -along[0]])
        corner = [*(middle - 0.5 * size[0] * along), z1 - place[1] * (z1 - z0) + 0.5 * size[1]]
        self.sheet(np.array(corner), size[0] * np.array([*along, 0.0]), np.array([0.0, 0.0, -size[1]]), paint)

    def board(self, middle: np.ndarray, squares: tuple[int, int], square_m: float) -> tuple[Board, np.ndarray]:
        """Adds a horizontal chessboard of squares (columns, rows) centred at (3,); its x axis is the world's."""
        across, down = np.diag([squares[0] + 2.0, -squares[1] - 2.0, 0.0])[:2] * square_m
        corner = middle - 0.5 * across - 0.5 * down
        paper = chessboard((squares[1], squares[0]), BOARD_TEXELS, BOARD_TEXELS)
        self.rectangles.append(Rectangle(corner, across, down, paper, _gain(across, down)))
        origin = corner + 2.0 * square_m * np.array([1.0, -1.0, 0.0])
        pose = SE3.from_matrix(np.column_stack([np.diag([1.0, -1.0, -1.0]), origin]))
        return Board(squares[0] - 1, squares[1] - 1, square_m), pose


def apart(
    draw: Callable[[], tuple[np.ndarray, float]], count: int, taken: list[tuple[np.ndarray, float]]
) -> list[tuple[np.ndarray, float]]:
    """Places (centre (2,), radius) of up to `count` objects that overlap neither each other nor `taken` places."""
    found: list[tuple[np.ndarray, float]] = []
    for _ in range(MOST_TRIES):
        if len(found) == count:
            break
        middle, radius = draw()
        if all(np.linalg.norm(middle - other) > radius + reach for other, reach in taken + found):
            found.append((middle, radius))
    return found


def _heading(yaw: float) -> np.ndarray:
    return np.array([np.cos(yaw), np.sin(yaw), 0.0])


def _gain(across: np.ndarray, down: np.ndarray) -> float:
    """Illumination of a rectangle's front."""
    normal = np.cross(down, across)
    return float(1.0 - DIRECT + DIRECT * normal @ LIGHT / np.linalg.norm(normal))
