"""A simulated laboratory for a robot with a stereo camera (S05 §V).

Its plan: two rooms of 18 m × 10 m together, a door between them, and a robot's drives through them. Its furniture:
shelves, tables, cabinets and cartons along the walls, tables in the middle, posters; all boxes are parallel to the walls,
so that occlusion is exact.

The world's z axis points up; x runs along the longer side from the corner of the first room, the floor is z = 0.

    python -m examples.studies.lab --out LAB --every 50 --width 320 --height 240
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal, NamedTuple

import numpy as np
import tyro

from examples.studies.drives import Drive, Move, Travelled, along_corners
from examples.studies.wheel_odometry import WheelOdometry, write_wheel_odometry
from rbpf.cli.options import RealPositive, WholeCount
from rbpf.cli.simulating import RenderOptions, render
from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.ranges import MOST, Count, Fraction, NotNegative, Positive, Range, Ranged, check_ranges
from rbpf.validation.simulation import textures
from rbpf.validation.simulation.laser import WheelOdometer
from rbpf.validation.simulation.textured_scene import Furniture, TexturedScene, stamps_ns
from rbpf.validation.simulation.textures import Paint

SIZE_M = 18.0, 10.0, 2.8  #: Size of both rooms together.
PARTITION_M = 9.9, 10.1  #: Extent along x of the wall between the rooms.
DOOR_M, LINTEL_M = (4.2, 5.8), 2.1  #: Extent of the door along y, and its height.
JAMB_M = 0.3  #: Clearance around the door.
#: Clearance of the walls along y from the rooms' corners, for the furniture of the other walls.
CORNER_M = 0.95
BEND_M, ARM_M, RAMP_S = 1.1, 0.5, 1.0  #: Parameters of the drive, see `Drive`.
TOUR_FRAMES, TURN_BACK_FRAMES = 4000, 600
RATE_HZ = 15.0
AWAY_DEG, AWAY_S = 140.0, 5.0  #: Angle and time for which the robot turns away.


@dataclass(frozen=True)
class Wall:
    """A wall with furniture along it.

    It is parallel to an axis, 0 for x and 1 for y, at a coordinate of the other one, along which +1 or -1 is into the
    room; furniture may stand in the intervals `free_m` (K, 2) along it.
    """

    axis: int
    at_m: float
    inwards: int
    free_m: Sequence[tuple[float, float]]

    def box(self, along: Sequence[float], deep: Sequence[float], high: Sequence[float]) -> np.ndarray:
        """(2, 3) corners of a box, from intervals along the wall, away from it and above the floor."""
        corners = np.empty((2, 3))
        corners[:, self.axis] = along
        corners[:, 1 - self.axis] = np.sort(self.at_m + self.inwards * np.asarray(deep, float))
        corners[:, 2] = high
        return corners

    def sheet(self, along: Sequence[float], deep: float, high: Sequence[float]) -> tuple[Array, Array, Array]:
        """Corner, across and down of a sheet parallel to the wall that faces the room."""
        left, right = along if self.inwards == (1 if self.axis else -1) else along[::-1]
        corner, across = np.zeros(3), np.zeros(3)
        corner[[self.axis, 1 - self.axis, 2]] = left, self.at_m + self.inwards * deep, high[1]
        across[self.axis] = right - left
        return corner, across, np.array([0.0, 0.0, high[0] - high[1]])


def walls() -> list[Wall]:
    """The eight walls, in the order first room, second room."""
    length, width, _ = SIZE_M
    middle = (CORNER_M, DOOR_M[0] - JAMB_M), (DOOR_M[1] + JAMB_M, width - CORNER_M)
    whole = ((CORNER_M, width - CORNER_M),)
    first, second = ((0.0, PARTITION_M[0]),), ((PARTITION_M[1], length),)
    return [
        Wall(1, 0.0, 1, whole),
        Wall(0, 0.0, 1, first),
        Wall(1, PARTITION_M[0], -1, middle),
        Wall(0, width, -1, first),
        Wall(1, PARTITION_M[1], 1, middle),
        Wall(0, 0.0, 1, second),
        Wall(1, length, -1, whole),
        Wall(0, width, -1, second),
    ]


#: (2, 2, 2) least and greatest x and y of the tables in the middle of the rooms.
ISLANDS = np.array([[[3.9, 3.8], [5.7, 6.2]], [[13.4, 4.0], [14.8, 6.0]]])

#: One and a half laps of the first room, through the door, a lap of the second room, back through the door, and half a
#: lap of the first room in the opposite direction.
TOUR = [
    *[(2.0, 5.0), (2.0, 2.1), (7.6, 2.1), (7.6, 7.9), (2.0, 7.9)],
    *[(2.0, 5.0), (2.0, 2.1), (7.6, 2.1), (7.6, 5.0)],
    *[(12.2, 5.0), (12.2, 2.3), (16.0, 2.3), (16.0, 7.7), (12.2, 7.7), (12.2, 5.0)],
    *[(7.6, 5.0), (7.6, 2.1), (2.0, 2.1), (2.0, 5.0)],
]


def tour() -> Drive:
    """A drive of 67.9 m in `TOUR_FRAMES` frames."""
    start, moves = along_corners(TOUR, BEND_M)
    return Drive(start, moves, (TOUR_FRAMES - 1) / RATE_HZ, ARM_M, RAMP_S)


def turn_back() -> Drive:
    """A drive of 3 m on which the robot twice turns away for `AWAY_S` and back (S05, footnote 1)."""
    away = np.deg2rad(AWAY_DEG)
    moves = [Move(1.5)]
    for turn in (away, -away):
        moves += [Move(turn_rad=turn), Move(turn_rad=-turn, rest_s=AWAY_S), Move(0.75)]
    return Drive(np.array([0.0, 1.6, 2.1]), moves, (TURN_BACK_FRAMES - 1) / RATE_HZ, ARM_M, RAMP_S)


ABOVE_M = 0.9  #: Height above which sheets are also visible from below.
TOUCHING_M = 0.002  #: Faces nearer to a wall than this are invisible.
#: Thickness of a shelf's boards, of a tabletop, of its legs, and of backboards.
BOARD_M, TOP_M, LEG_M, BACK_M = 0.025, 0.04, 0.05, 0.01
TABLE_M = 0.74
HANG_M = 0.01  #: Distance of posters from their background.


class Surface(NamedTuple):
    """A visible parallelogram, as in `Rectangle`, and the paint of its texture."""

    corner: np.ndarray
    across: np.ndarray
    down: np.ndarray
    paint: Paint


@dataclass
class Furnishing:
    """Collects the objects of the laboratory: opaque boxes with their visible faces, and posters."""

    rng: np.random.Generator
    blocks: list[np.ndarray] = field(default_factory=list)  #: (2, 3) least and greatest corner of each box.
    surfaces: list[Surface] = field(default_factory=list)

    def add(self, box: np.ndarray, side: Paint, top: Paint) -> None:
        """Adds a box (2, 3): sides, top and, high above the floor, bottom, facing outwards; except faces that touch a wall."""
        self.blocks.append(box)
        (x0, y0, z0), (x1, y1, z1) = box
        up = np.array([0.0, 0.0, z1 - z0])
        ring = np.array([[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]])
        ends = [(1, y0), (0, x1), (1, y1), (0, x0)]
        for left, right, (axis, at) in zip(ring, np.roll(ring, -1, axis=0), ends, strict=True):
            if min(abs(at), abs(SIZE_M[axis] - at)) >= TOUCHING_M:
                self.surfaces.append(Surface(left, right - left, -up, side))
        if z1 < SIZE_M[2] - TOUCHING_M:
            self.surfaces.append(Surface(ring[3], ring[2] - ring[3], ring[0] - ring[3], top))
        if z0 > ABOVE_M:
            self.surfaces.append(Surface(ring[0] - up, ring[1] - ring[0], ring[3] - ring[0], side))

    def hang(self, wall: Wall, middle: float, high: float, size: tuple[float, float], deep: float = 0.0) -> None:
        """Adds a poster (width, height) `deep` in front of a wall, centred at `middle` along it and `high` above the floor."""
        paint = textures.picture if self.rng.random() < 0.7 else textures.page
        wide, tall = 0.5 * size[0], 0.5 * size[1]
        sheet = wall.sheet((middle - wide, middle + wide), deep + HANG_M, (high - tall, high + tall))
        self.surfaces.append(Surface(*sheet, paint))

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))


def furnished(rng: np.random.Generator) -> Furnishing:
    """The laboratory without floor, ceiling and outer walls; the same generator gives the same laboratory."""
    lab, (x0, x1), (y0, y1), (_, width, height) = Furnishing(rng), PARTITION_M, DOOR_M, SIZE_M
    # The wall between the rooms: on both sides of the door and above it.
    for start, end, low in ((0.0, y0, 0.0), (y1, width, 0.0), (y0, y1, LINTEL_M)):
        lab.add(np.array([[x0, start, low], [x1, end, height]]), textures.plaster, textures.plaster)
    for wall in walls():
        for start, end in wall.free_m:
            _along(lab, wall, start, end)
    for low, high in ISLANDS:
        _island(lab, low, high)
    return lab


def shell() -> list[tuple[Surface, float]]:
    """Outer walls, floors and ceiling, each with the factor on its texel size."""
    length, width, height = SIZE_M
    ring = np.array([[0.0, width], [length, width], [length, 0.0], [0.0, 0.0]])
    corners, sides = np.c_[ring, np.full(4, height)], np.c_[np.roll(ring, -1, axis=0) - ring, np.zeros(4)]
    down, along = np.array([0.0, 0.0, -height]), np.array([0.0, -width, 0.0])
    found = [(Surface(*side, down, textures.plaster), 1.0) for side in zip(corners, sides, strict=True)]
    middle = float(np.mean(PARTITION_M))
    for x0, x1, paint in ((0.0, middle, textures.wood), (middle, length, textures.carpet)):
        found.append((Surface(np.array([x0, width, 0.0]), np.array([x1 - x0, 0.0, 0.0]), along, paint), 2.0))
    ceiling = Surface(corners[1], np.array([-length, 0.0, 0.0]), along, textures.plaster)
    return [*found, (ceiling, 4.0)]


def _along(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """Fills an interval along a wall with furniture."""
    kinds = _shelf, _table, _cabinet, _cartons
    place, last = start + lab.uniform(0.0, 0.3), -1
    while True:
        kind = int(lab.rng.choice([k for k in range(len(kinds)) if k != last]))
        wide = lab.uniform(*WIDTHS_M[kind])
        if place + wide > end:
            return
        kinds[kind](lab, wall, place, place + wide)
        place, last = place + wide + lab.uniform(0.05, 0.5), kind


WIDTHS_M = (0.9, 1.5), (1.2, 1.8), (0.6, 1.0), (0.5, 1.1)  #: Of a shelf, a table, a cabinet, and a heap of cartons.


def _shelf(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """Two uprights, a back, boards, and objects on them."""
    deep, high = lab.uniform(0.35, 0.45), lab.uniform(1.6, 2.1)
    for left in (start, end - BOARD_M):
        lab.add(wall.box((left, left + BOARD_M), (0.0, deep), (0.0, high)), textures.wood, textures.wood)
    inner = start + BOARD_M, end - BOARD_M
    lab.add(wall.box(inner, (0.0, BACK_M), (0.0, high)), textures.plaster, textures.wood)
    levels = np.linspace(0.08, high, int(lab.rng.integers(5, 7)))
    for low, top in zip(levels, [*levels[1:], high + 0.4], strict=True):
        lab.add(wall.box(inner, (BACK_M, deep), (low - BOARD_M, low)), textures.wood, textures.wood)
        _row(lab, wall, inner, deep, low, top - BOARD_M)


def spines(shape: textures.Shape, rng: np.random.Generator) -> np.ndarray:
    """Spines of books side by side, each with bands and a title."""
    row = textures.grey_levels(60.0 + 6.0 * textures.clouds(shape, rng))
    column = 0
    while column < shape[1]:
        wide = int(rng.integers(6, 19))
        top = int(rng.uniform(0.0, 0.25) * shape[0])
        back = row[top:, column : column + wide]
        back[...] = textures.grey_levels(rng.uniform(40, 220) + 5.0 * rng.standard_normal((1, back.shape[1])))
        for place, high in zip(rng.uniform(0.05, 0.9, 3), rng.uniform(0.01, 0.12, 3), strict=True):
            start = int(place * len(back))
            back[start : start + 1 + int(high * len(back)), 1:-1] = rng.uniform(20, 235)
        column += wide + int(rng.integers(0, 2))
    return row


def _row(lab: Furnishing, wall: Wall, along: tuple[float, float], deep: float, low: float, top: float) -> None:
    """Books and boxes side by side on a board, with gaps."""
    place = along[0] + lab.uniform(0.0, 0.1)
    while place + 0.15 < along[1]:
        wide = min(lab.uniform(0.15, 0.55), along[1] - place)
        books = lab.rng.random() < 0.5
        high = min(lab.uniform(0.6, 0.95) * (top - low), 0.33 if books else 0.45)
        front = deep - lab.uniform(0.01, 0.08)
        paint = spines if books else textures.carton
        lab.add(wall.box((place, place + wide), (BACK_M, front), (low, low + high)), paint, textures.carton)
        place += wide + lab.uniform(0.01, 0.2)


def _table(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """A table with objects on it, perhaps a carton below, and a poster above."""
    deep = lab.uniform(0.6, 0.8)
    _desk(lab, wall, (start, end), (0.0, deep))
    if lab.rng.random() < 0.5:
        left = lab.uniform(start + 0.1, end - 0.6)
        box = wall.box((left, left + 0.45), (0.05, 0.45), (0.0, lab.uniform(0.25, 0.45)))
        lab.add(box, textures.carton, textures.carton)
    for left, right in ((start, 0.5 * (start + end)), (0.5 * (start + end), end)):
        _poster(lab, wall, left, right, lab.uniform(1.45, 1.75))


def _desk(lab: Furnishing, wall: Wall, along: tuple[float, float], deep: tuple[float, float], rows: int = 1) -> None:
    """A tabletop, legs, and rows of objects on it."""
    lab.add(wall.box(along, deep, (TABLE_M - TOP_M, TABLE_M)), textures.wood, textures.wood)
    for left in (along[0], along[1] - LEG_M):
        for back in (deep[0], deep[1] - LEG_M):
            leg = wall.box((left, left + LEG_M), (back, back + LEG_M), (0.0, TABLE_M - TOP_M))
            lab.add(leg, textures.plaster, textures.plaster)
    for row in np.linspace(*deep, rows + 1)[:-1]:
        place = along[0] + lab.uniform(0.05, 0.3)
        while place + 0.5 < along[1]:
            wide, back = lab.uniform(0.15, 0.45), row + lab.uniform(0.05, 0.2)
            low, high = TABLE_M, TABLE_M + lab.uniform(0.08, 0.5)
            thing = wall.box((place, place + wide), (back, back + lab.uniform(0.1, 0.3)), (low, high))
            lab.add(thing, textures.carton, textures.carton)
            place += wide + lab.uniform(0.1, 0.4)


def _cabinet(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """A closed box, with a sheet or two on its door."""
    deep, high = lab.uniform(0.4, 0.6), lab.uniform(1.0, 2.0)
    lab.add(wall.box((start, end), (0.0, deep), (0.0, high)), textures.wood, textures.plaster)
    for level in (0.35, 0.75):
        size = lab.uniform(0.15, 0.5), lab.uniform(0.15, 0.35)
        middle = 0.5 * (start + end) + lab.uniform(-0.05, 0.05)
        lab.hang(wall, middle, level * high, size, deep)


def _cartons(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """A stack of cartons, each smaller than the one below, and a poster above."""
    low, deep = 0.0, lab.uniform(0.4, 0.6)
    while low < 1.2:
        high = low + lab.uniform(0.25, 0.5)
        lab.add(wall.box((start, end), (0.0, deep), (low, high)), textures.carton, textures.carton)
        start, end = start + lab.uniform(0.0, 0.15), end - lab.uniform(0.0, 0.15)
        low, deep = high, 0.9 * deep
        if end - start < 0.35 or lab.rng.random() < 0.35:
            break
    _poster(lab, wall, start, end, max(low + 0.5, lab.uniform(1.4, 1.7)))


def _poster(lab: Furnishing, wall: Wall, start: float, end: float, high: float) -> None:
    """A poster on a wall, at random between two positions, and a smaller one above it."""
    wide = lab.uniform(0.6, 0.95) * (end - start)
    middle = lab.uniform(start + 0.5 * wide, end - 0.5 * wide)
    lab.hang(wall, middle, high, (wide, lab.uniform(0.35, 0.7)))
    lab.hang(wall, middle, high + 0.65, (0.7 * wide, lab.uniform(0.15, 0.4)))


def _island(lab: Furnishing, low: np.ndarray, high: np.ndarray) -> None:
    """Two tables back to back with objects, and a board with posters between them."""
    middle = 0.5 * float(low[0] + high[0])
    along = float(low[1]), float(high[1])
    board = 0.5 * BACK_M
    screen = np.array([[middle - board, along[0] + 0.2, TABLE_M], [middle + board, along[1] - 0.2, 1.45]])
    lab.add(screen, textures.plaster, textures.wood)
    for inwards in (-1, 1):
        side = Wall(1, middle + inwards * board, inwards, (along,))
        _desk(lab, side, along, (0.0, 0.5 * float(high[0] - low[0]) - board), rows=2)
        for place in np.linspace(along[0] + 0.6, along[1] - 0.6, 3).tolist():
            size = lab.uniform(0.25, 0.5), lab.uniform(0.2, 0.35)
            lab.hang(side, place, 1.22, size)


#: (7,) the left camera faces forwards, 1 m above the floor, slightly ahead and to the left of the wheels' centre; the
#: robot's frame has x forwards, y to the left, z up, and its origin between the wheels on the floor.
ROBOT_FROM_CAMERA = SE3.from_matrix(np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.06], [0.0, -1.0, 0.0, 1.0]]))


@dataclass(frozen=True)
class LabDrive:
    """A robot's drive through the laboratory."""

    #: "tour" through both rooms and back, 4,000 frames over 67.9 m; or "turn_back", 600 frames, on which the robot
    #: twice looks away for 5 s and back.
    trajectory: Literal["tour", "turn_back"] = "tour"
    frames: Annotated[int | None, Range(ge=2, le=MOST)] = None  #: maximum number of images; None for all.
    every: Count = 1  #: every n-th frame of the trajectory becomes an image.

    def __post_init__(self) -> None:
        check_ranges(self)
        most = -(-DRIVES[self.trajectory][1] // self.every)
        if not 2 <= (self.frames or most) <= most:
            raise InputError(
                f"with every = {self.every} the {self.trajectory} has {most} images; give 2 or more, got {self.frames}"
            )

    @property
    def images(self) -> np.ndarray:
        """(T,) the frames of the trajectory that become images."""
        return np.arange(self.frames or -(-DRIVES[self.trajectory][1] // self.every)) * self.every

    def travelled(self) -> Travelled:
        """The robot in every frame of the trajectory up to the last image."""
        drive, _ = DRIVES[self.trajectory]
        return drive()(np.arange(self.images[-1] + 1) / RATE_HZ)


#: A drive and its number of frames, by name.
DRIVES = {"tour": (tour, TOUR_FRAMES), "turn_back": (turn_back, TURN_BACK_FRAMES)}


def world_from_camera(world_from_robot: np.ndarray) -> np.ndarray:
    """(T, 7) poses of the left camera for poses (T, 3) of the robot, elements of SE(2)."""
    theta, x, y = world_from_robot.T
    still = np.zeros_like(theta)
    return SE3.compose(SE3.from_ypr(np.stack([x, y, still], axis=-1), theta, still, still), ROBOT_FROM_CAMERA)


@dataclass(frozen=True)
class TexturedLab(Ranged):
    """Two rooms of 18 m × 10 m together, with shelves, tables, cabinets, cartons and posters."""

    drive: LabDrive = LabDrive()  #: drive of the robot with the camera.
    texel_m: Positive = 0.003  #: side of a texel; twice this for floors, four times for the ceiling.
    contrast: NotNegative = 1.0  #: of all textures; 1 is rich, 0.1 poor.

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws the furniture and the textures; the drive is fixed.

        A shorter drive does not change the random draws.
        """
        lab = furnished(rng)
        rectangles = []
        for surface, coarse in [*shell(), *((surface, 1.0) for surface in lab.surfaces)]:
            furniture = Furniture(rng, coarse * self.texel_m, self.contrast)
            furniture.sheet(surface.corner, surface.across, surface.down, surface.paint)
            rectangles += furniture.rectangles
        images = self.drive.images
        path = world_from_camera(self.drive.travelled().world_from_robot)[images]
        return TexturedScene("lab", stamps_ns(int(images[-1]) + 1, RATE_HZ)[images], path, rectangles)

    def wheels(self, seed: int) -> WheelOdometry:
        """Wheel odometry at every frame of the trajectory, also those without an image."""
        slip, travelled = np.random.default_rng(seed).spawn(1)[0], self.drive.travelled()
        stamps = stamps_ns(len(travelled.way_m), RATE_HZ)
        return WheelOdometry(
            stamps, *WheelOdometer().measure(travelled.way_m, travelled.heading_rad, slip), ROBOT_FROM_CAMERA
        )


@dataclass(frozen=True, kw_only=True)
class RenderLab(RenderOptions):
    """Options of rendering."""

    focal_fraction = 0.78125
    #: a tour of 4,000 images over 68 m through both rooms and back, or 600 images on which the robot twice looks away
    #: for 5 s and back.
    trajectory: Literal["tour", "turn_back"] = "tour"
    frames: WholeCount = None  #: number of images, the first ones; by default all.
    every: Count = 1  #: every n-th frame becomes an image.
    focal_px: RealPositive = None  #: focal length, px; by default 0.78125 of the width, 500 px at 640.
    #: baseline to a second camera on the right, m; None for none.
    baseline_m: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = 0.12
    noise_std: NotNegative = 8.0  #: standard deviation of the sensor noise, grey levels.
    blur_s: NotNegative = 0.0  #: exposure time, s.
    exposure_drift: Fraction = 0.0  #: largest relative change of the exposure.
    vignetting: Fraction = 0.0  #: relative loss of light in the corners.
    texel_m: Annotated[float, Range(ge=1e-4, le=1.0)] = 0.003  #: side of a texel, m; larger ones are faster to draw.


def simulate_lab(options: Annotated[RenderLab, tyro.conf.arg(name="")]) -> None:
    """Stereo images of a laboratory of two rooms, taken from a robot, with ground truth and wheel odometry."""
    check_ranges(options)
    drive = LabDrive(options.trajectory, options.frames, options.every)
    world = TexturedLab(drive, options.texel_m, options.contrast)
    render(world, options)
    write_wheel_odometry(options.out, world.wheels(options.seed))


if __name__ == "__main__":
    tyro.cli(simulate_lab)
