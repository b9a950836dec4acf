"""Simulated scenes for cameras: a textured desk with objects on it, and a textured room. The z axis points up."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rbpf.lie import SE3
from rbpf.ranges import MOST, CountOrNone, NotNegative, Positive, Range, Ranged
from rbpf.validation.simulation import textures
from rbpf.validation.simulation.paths import HandHeld, Wave, eased, looking
from rbpf.validation.simulation.textured_scene import Furniture, TexturedScene, apart, stamps_ns

SHEET_M = 0.0001  #: Vertical distance between stacked sheets of paper.

#: Size and texture of flat objects on a desk: pages, magazines, postcards, notes, cards, pencils.
PAPERS = [
    ((0.21, 0.297), textures.page),
    ((0.30, 0.21), textures.picture),
    ((0.12, 0.17), textures.picture),
    ((0.08, 0.08), textures.carton),
    ((0.09, 0.055), textures.carton),
    ((0.15, 0.014), textures.carton),
]

DESK_M, HIGHEST_M = 0.75, 0.25  #: Height of a desk, and of the tallest object on it.
BOOKS = 0.4  #: Fraction of books among the objects; the others are boxes.
COARSE = 4.0  #: Factor on the texel size of the walls around a desk, which are farther away.
OVER_DESK = HandHeld(nearest_m=0.8, farthest_m=1.3, elevation_deg=50.0, wander=0.25)
#: Clearance around a chessboard's corners, so that the whole board is visible from the start pose.
BOARD_CLEAR_M = 0.15


@dataclass(frozen=True)
class TexturedDesk(Ranged):
    """A desk at a wall, with papers, books and boxes on it, observed by a hand-held camera that starts at rest.

    The origin is the centre of the desktop; the wall is beyond its edge of largest y.
    """

    frames: Annotated[int, Range(ge=2, le=MOST)] = 300  #: number of images.
    rate_hz: Positive = 30.0  #: images per second.
    size_m: tuple[Positive, Positive] = (2.0, 2.0)  #: of the desktop along x and y.
    papers: CountOrNone = 42  #: number of flat objects.
    things: CountOrNone = 16  #: maximum number of books and boxes; fewer if there is no room.
    #: squares (columns, rows) of a chessboard in the middle; None for none.
    board: Annotated[tuple[int, int] | None, Range(ge=4, le=1000)] = None
    square_m: Positive = 0.03  #: side of its squares.
    hand: HandHeld = OVER_DESK  #: motion of the camera.
    texel_m: Positive = 0.001  #: side of a texel.
    contrast: NotNegative = 1.0  #: of all textures but the chessboard's; 1 is rich, 0.1 poor.

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws the textures, the objects and the path."""
        rng.random(3)  # skipped, so that a seed gives the same desk as in earlier versions
        path = self.hand.poses(np.arange(self.frames) / self.rate_hz, (*self.size_m, HIGHEST_M), rng)
        # The surroundings of the desktop.
        x, y = 0.5 * np.array(self.size_m)
        room = np.array([[-x - 2.0, -y - 2.5, -DESK_M], [x + 2.0, y + 0.01, 2.6 - DESK_M]])
        around = Furniture(rng, COARSE * self.texel_m, self.contrast)
        around.shell(room, textures.wallpaper, textures.carpet, textures.plaster)
        block = (*self.size_m, DESK_M - SHEET_M)
        around.box(np.array([0.0, 0.0, -DESK_M]), 0.0, block, textures.wood, textures.wood)
        for fraction in (0.5 + (np.arange(4) - 1.5) * 0.35 * x / (x + 2.0)).tolist():
            size = (rng.uniform(0.25, 0.5, 2) * x).tolist()
            around.hang(room, 0, (fraction, rng.uniform(0.45, 0.55)), size, textures.picture)
        # The desktop, papers, and the chessboard on top of them.
        desk = Furniture(rng, self.texel_m, self.contrast)
        desk.flat(np.zeros(3), 0.0, self.size_m, textures.wood)
        for k in range(self.papers):
            sheet, paint = PAPERS[k % len(PAPERS)]
            middle = rng.uniform(-0.45, 0.45, 2) * self.size_m
            desk.flat(np.array([*middle, (k + 1) * SHEET_M]), rng.uniform(-np.pi, np.pi), sheet, paint)
        board, taken = [], []
        if self.board is not None:
            board.append(desk.board(np.array([0.0, 0.0, (self.papers + 1) * SHEET_M]), self.board, self.square_m))
            taken.append((np.zeros(2), 0.5 * self.square_m * float(np.hypot(*self.board)) + BOARD_CLEAR_M))

        def draw() -> tuple[np.ndarray, float]:
            return rng.uniform(-0.42, 0.42, 2) * self.size_m, rng.uniform(0.06, 0.16)

        # Books and boxes.
        for middle, radius in apart(draw, self.things, taken):
            foot, yaw = np.array([*middle, 0.0]), rng.uniform(-np.pi, np.pi)
            turn = rng.uniform(0.6, 1.0)
            is_book = rng.random() < BOOKS
            height = rng.uniform(0.02, 0.06) if is_book else rng.uniform(0.06, HIGHEST_M)
            extent = (2.0 * radius * np.cos(turn), 2.0 * radius * np.sin(turn), height)
            prints = (textures.picture, textures.edges_of_pages) if is_book else (textures.carton,) * 2
            desk.box(foot, yaw, extent, *prints)
        rectangles = around.rectangles + desk.rectangles
        return TexturedScene("desk", stamps_ns(self.frames, self.rate_hz), path, rectangles, board)


#: Size of a room along x, y and z, pictures on each wall, and maximum number of boxes on the floor.
ROOM_M, PICTURES, BOXES = (6.0, 5.0, 2.6), 5, 14
#: Radius of the walked circle, height of the camera, and its gaze: outwards from straight ahead, and downwards.
RADIUS_M, EYE_M, GAZE_DEG, DROP_DEG = 1.0, 1.4, 60.0, 10.0
#: Frequencies of the hand's shake, and its largest translation and rotation per axis.
SHAKE_HZ, SHAKE_M, SHAKE_DEG = (0.3, 1.5), 0.03, 3.0
ALONG_M = 0.7  #: Objects along a room's walls are within this distance of them.


@dataclass(frozen=True)
class TexturedRoom(Ranged):
    """A room with pictures on its walls and boxes along them; a camera is carried in a circle and faces outwards.

    The origin is the centre of the floor. The walk is counter-clockwise from (`RADIUS_M`, 0).
    """

    frames: Annotated[int, Range(ge=2, le=MOST)] = 600  #: number of images.
    rate_hz: Positive = 30.0  #: images per second.
    speed_m_s: Positive = 0.4  #: walking speed.
    start_s: NotNegative = 1.0  #: time until the walk reaches its speed.
    texel_m: Positive = 0.0025  #: side of a texel.
    contrast: NotNegative = 1.0  #: of all textures; 1 is rich, 0.1 poor.

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws the textures, the objects and the path."""
        # A circle, facing outwards, with a shaking hand.
        time = eased(np.arange(self.frames) / self.rate_hz, self.start_s)
        turn = self.speed_m_s * time / RADIUS_M
        eye = np.stack([RADIUS_M * np.cos(turn), RADIUS_M * np.sin(turn), np.full_like(turn, EYE_M)], axis=-1)
        heading = turn + 0.5 * np.pi - np.deg2rad(GAZE_DEG)
        drop = np.full_like(turn, -np.tan(np.deg2rad(DROP_DEG)))
        bound = np.array([np.deg2rad(SHAKE_DEG)] * 3 + [SHAKE_M] * 3)
        direction = np.stack([np.cos(heading), np.sin(heading), drop], axis=-1)
        path = SE3.retract(looking(eye, direction), Wave.random(bound, SHAKE_HZ, rng)(time))
        # The room, and pictures on its walls.
        half = 0.5 * np.array(ROOM_M[:2])
        room = np.array([[*-half, 0.0], [*half, ROOM_M[2]]])
        furniture = Furniture(rng, self.texel_m, self.contrast)
        furniture.shell(room, textures.wallpaper, textures.carpet, textures.plaster)
        for wall in range(4):
            for k in range(PICTURES):
                place = ((k + rng.uniform(0.35, 0.65)) / PICTURES, rng.uniform(0.3, 0.55))
                furniture.hang(room, wall, place, rng.uniform(0.35, 0.8, 2).tolist(), textures.picture)

        def draw() -> tuple[np.ndarray, float]:
            radius = rng.uniform(0.2, 0.5 * ALONG_M)
            place = rng.uniform(-1.0, 1.0, 2) * (half - radius)
            wall = rng.integers(2)
            place[wall] = np.copysign(half[wall] - radius, place[wall])
            return place, radius

        # Boxes along the walls.
        for middle, radius in apart(draw, BOXES, []):
            side = radius * np.sqrt(2.0)
            size = (side, side, rng.uniform(0.3, 0.6 * ROOM_M[2]))
            foot, yaw = np.array([*middle, 0.0]), rng.uniform(-0.5, 0.5)
            furniture.box(foot, yaw, size, textures.carton, textures.carton)
        return TexturedScene("room", stamps_ns(self.frames, self.rate_hz), path, furniture.rectangles)
