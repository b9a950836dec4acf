"""Builds rooms and things from textured rectangles. The world's z axis points up."""

from collections.abc import Callable, Sequence

import numpy as np

from rbpf.lie import SE3
from rbpf.validation.simulation.textured_scene import Chessboard, Rectangle
from rbpf.validation.simulation.textures import Paint, chessboard, faded

LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
"""Direction to the lamp."""

DIRECT = 0.25
"""Share of the light that comes from there."""

MOST_TRIES = 1000
"""Places drawn for things that do not touch."""

BOARD_TEXELS = 40
"""Per square of a chessboard; its white margin is one square wide."""


class Furniture:
    """Collects rectangles, each with a texture of its own."""

    def __init__(self, rng: np.random.Generator, texel_m: float, contrast: float) -> None:
        """Starts with nothing.

        Args:
            rng: generator.
            texel_m: side of a texel on all that is built.
            contrast: of all textures, a factor.
        """
        self.rectangles: list[Rectangle] = []
        self._rng, self._texel_m, self._contrast = rng, texel_m, contrast

    def sheet(self, corner: np.ndarray, across: np.ndarray, down: np.ndarray, paint: Paint) -> None:
        """A rectangle in the light."""
        shape = [max(8, round(float(np.linalg.norm(side)) / self._texel_m)) for side in (down, across)]
        texture = faded(paint((shape[0], shape[1]), self._rng), self._contrast)
        self.rectangles.append(Rectangle(corner, across, down, texture, _gain(across, down)))

    def flat(self, middle: np.ndarray, yaw: float, size: Sequence[float], paint: Paint) -> None:
        """A sheet (wide, long) that lies with its middle at (3,)."""
        across, up = size[0] * _heading(yaw), size[1] * _heading(yaw + 0.5 * np.pi)
        self.sheet(middle - 0.5 * across + 0.5 * up, across, -up, paint)

    def box(self, foot: np.ndarray, yaw: float, size: Sequence[float], top: Paint, side: Paint) -> None:
        """A box (wide, long, high) that stands with the middle of its foot at (3,)."""
        x, y = 0.5 * size[0] * _heading(yaw), 0.5 * size[1] * _heading(yaw + 0.5 * np.pi)
        height = np.array([0.0, 0.0, size[2]])
        ring = [foot + height + corner for corner in (-x - y, x - y, x + y, y - x)]
        for left, right in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self.sheet(left, right - left, -height, side)
        self.sheet(ring[3], 2.0 * x, -2.0 * y, top)

    def shell(self, room: np.ndarray, wall: Paint, floor: Paint, ceiling: Paint) -> None:
        """Walls, floor and ceiling of a room (2, 3), its least and greatest corner, seen from within."""
        (x0, y0, z0), (x1, y1, z1) = room
        height = np.array([0.0, 0.0, z1 - z0])
        ring = np.array([[x0, y1, z1], [x1, y1, z1], [x1, y0, z1], [x0, y0, z1]])
        for left, right in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self.sheet(left, right - left, -height, wall)
        self.sheet(ring[0] - height, ring[1] - ring[0], ring[3] - ring[0], floor)
        self.sheet(ring[3], ring[2] - ring[3], ring[0] - ring[3], ceiling)

    def hang(
        self, room: np.ndarray, wall: int, place: Sequence[float], size: Sequence[float], paint: Paint
    ) -> None:
        """A picture (wide, high) on a wall of a room.

        Args:
            room: (2, 3) least and greatest corner.
            wall: 0 to 3, those at the greatest y and x, then at the least y and x.
            place: of its middle, as fractions of the wall from the left and from the top.
            size: m.
            paint: draws it.
        """
        (x0, y0, z0), (x1, y1, z1) = room
        left, right = np.roll(np.array([[x0, y1], [x1, y1], [x1, y0], [x0, y0]]), -wall, axis=0)[:2]
        along = (right - left) / np.linalg.norm(right - left)
        middle = left + place[0] * (right - left) + 0.01 * np.array([along[1], -along[0]])
        corner = [*(middle - 0.5 * size[0] * along), z1 - place[1] * (z1 - z0) + 0.5 * size[1]]
        self.sheet(np.array(corner), size[0] * np.array([*along, 0.0]), np.array([0.0, 0.0, -size[1]]), paint)

    def board(self, middle: np.ndarray, squares: tuple[int, int], square_m: float) -> Chessboard:
        """A chessboard of squares (columns, rows) that lies with its middle at (3,); its x axis is the world's."""
        across, down = np.diag([squares[0] + 2.0, -squares[1] - 2.0, 0.0])[:2] * square_m
        corner = middle - 0.5 * across - 0.5 * down
        paper = chessboard((squares[1], squares[0]), BOARD_TEXELS, BOARD_TEXELS)
        self.rectangles.append(Rectangle(corner, across, down, paper, _gain(across, down)))
        origin = corner + 2.0 * square_m * np.array([1.0, -1.0, 0.0])
        pose = SE3.from_matrix(np.column_stack([np.diag([1.0, -1.0, -1.0]), origin]))
        return Chessboard(squares[0] - 1, squares[1] - 1, square_m, pose)


def apart(
    draw: Callable[[], tuple[np.ndarray, float]],
    count: int,
    taken: list[tuple[np.ndarray, float]],
) -> list[tuple[np.ndarray, float]]:
    """Places of up to `count` things that do not touch: (2,) middles and radii; those that find no place are left out.

    Args:
        draw: a middle and a radius.
        count: most of them.
        taken: places where nothing may stand.
    """
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
    """Light on a sheet that faces the viewer."""
    normal = np.cross(down, across)
    return float(1.0 - DIRECT + DIRECT * normal @ LIGHT / np.linalg.norm(normal))
