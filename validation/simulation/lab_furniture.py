"""Furnishes the laboratory: shelves, tables, cabinets and cartons along its walls, tables in the middle, posters.

All boxes are parallel to the walls, so that what is hidden is known exactly for images and for points alike.
"""

from dataclasses import dataclass, field

import numpy as np

from rbpf.validation.simulation import textures
from rbpf.validation.simulation.lab_plan import ISLANDS, PARTITION_M, SIZE_M, Wall, partition, walls
from rbpf.validation.simulation.textures import Paint

Box = np.ndarray
"""(2, 3) least and greatest corner."""

ABOVE_M = 0.9
"""What hangs higher than this is seen from below as well."""

TOUCHING_M = 0.002
"""Faces nearer to a wall than this are not seen."""

BOARD_M, TOP_M, LEG_M, BACK_M = 0.025, 0.04, 0.05, 0.01
"""Thickness of a shelf's boards, of a table's top, of its legs, and of what things lean against."""

TABLE_M = 0.74

HANG_M = 0.01
"""Posters are this far from what they hang on."""


@dataclass(frozen=True)
class Surface:
    """A flat parallelogram that can be seen, as `Rectangle` has it.

    Attributes:
        corner: (3,) top left, m.
        across: (3,) to the top right, m.
        down: (3,) to the bottom left, m.
        paint: of its texture.
    """

    corner: np.ndarray
    across: np.ndarray
    down: np.ndarray
    paint: Paint

    @property
    def area_m2(self) -> float:
        """Area."""
        return float(np.linalg.norm(np.cross(self.across, self.down)))


@dataclass
class Furnishing:
    """Collects what stands and hangs in the laboratory.

    Attributes:
        rng: generator of all sizes and places.
        blocks: opaque boxes.
        surfaces: what can be seen of them, and posters.
    """

    rng: np.random.Generator
    blocks: list[Box] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)

    def add(self, box: Box, side: Paint, top: Paint) -> None:
        """A box with its visible faces."""
        self.blocks.append(box)
        self.surfaces += faces(box, side, top)

    def hang(self, wall: Wall, middle: float, high: float, size: tuple[float, float], paint: Paint) -> None:
        """A sheet (wide, high) on a wall, its middle at a place along it and above the floor."""
        wide, tall = 0.5 * size[0], 0.5 * size[1]
        sheet = wall.sheet((middle - wide, middle + wide), HANG_M, (high - tall, high + tall))
        self.surfaces.append(Surface(*sheet, paint))

    def uniform(self, low: float, high: float) -> float:
        """A number between two others."""
        return float(self.rng.uniform(low, high))


def faces(box: Box, side: Paint, top: Paint) -> list[Surface]:
    """Sides, top and, high above the floor, bottom of a box, seen from without; not those that touch a wall."""
    (x0, y0, z0), (x1, y1, z1) = box
    up = np.array([0.0, 0.0, z1 - z0])
    ring = np.array([[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]])
    ends = [(1, y0), (0, x1), (1, y1), (0, x0)]
    found = [
        Surface(left, right - left, -up, side)
        for left, right, (axis, at) in zip(ring, np.roll(ring, -1, axis=0), ends, strict=True)
        if not _at_a_wall(axis, at)
    ]
    if z1 < SIZE_M[2] - TOUCHING_M:
        found.append(Surface(ring[3], ring[2] - ring[3], ring[0] - ring[3], top))
    if z0 > ABOVE_M:
        found.append(Surface(ring[0] - up, ring[1] - ring[0], ring[3] - ring[0], side))
    return found


def furnished(rng: np.random.Generator) -> Furnishing:
    """The laboratory without floor, ceiling and outer walls; the same generator gives the same laboratory."""
    lab = Furnishing(rng)
    for block in partition():
        lab.add(block, textures.plaster, textures.plaster)
    for wall in walls():
        for start, end in wall.free_m:
            _along(lab, wall, start, end)
    for low, high in ISLANDS:
        _island(lab, low, high)
    return lab


def shell() -> list[tuple[Surface, float]]:
    """Outer walls, floors and ceiling, each with the size of its texels as a multiple of the others'."""
    length, width, height = SIZE_M
    ring = np.array([[0.0, width], [length, width], [length, 0.0], [0.0, 0.0]])
    down = np.array([0.0, 0.0, -height])
    found = []
    for left, right in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        found.append(
            (Surface(np.append(left, height), np.append(right - left, 0.0), down, textures.plaster), 1.0)
        )
    middle = float(np.mean(PARTITION_M))
    along = np.array([0.0, -width, 0.0])
    for (x0, x1), paint in {(0.0, middle): textures.wood, (middle, length): textures.carpet}.items():
        found.append((Surface(np.array([x0, width, 0.0]), np.array([x1 - x0, 0.0, 0.0]), along, paint), 2.0))
    ceiling = Surface(
        np.array([length, width, height]), np.array([-length, 0.0, 0.0]), along, textures.plaster
    )
    return [*found, (ceiling, 4.0)]


def _at_a_wall(axis: int, at: float) -> bool:
    """Whether a face with this coordinate touches an outer wall or that between the rooms."""
    near = [0.0, SIZE_M[axis]]
    return bool(np.abs(np.subtract(near, at)).min() < TOUCHING_M)


def _along(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """Fills an interval along a wall, piece by piece."""
    kinds = _shelf, _table, _cabinet, _cartons
    place, last = start + lab.uniform(0.0, 0.3), -1
    while True:
        kind = int(lab.rng.choice([k for k in range(len(kinds)) if k != last]))
        wide = lab.uniform(*WIDTHS_M[kind])
        if place + wide > end:
            return
        kinds[kind](lab, wall, place, place + wide)
        place, last = place + wide + lab.uniform(0.05, 0.5), kind


WIDTHS_M = (0.9, 1.5), (1.2, 1.8), (0.6, 1.0), (0.5, 1.1)
"""Of a shelf, a table, a cabinet, and a heap of cartons."""


def _shelf(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """Two uprights, a back, boards, and what stands on them."""
    deep, high = lab.uniform(0.35, 0.45), lab.uniform(1.6, 2.1)
    for left in (start, end - BOARD_M):
        lab.add(wall.box((left, left + BOARD_M), (0.0, deep), (0.0, high)), textures.wood, textures.wood)
    inner = start + BOARD_M, end - BOARD_M
    lab.add(wall.box(inner, (0.0, BACK_M), (0.0, high)), textures.plaster, textures.wood)
    levels = np.linspace(0.08, high, int(lab.rng.integers(5, 7)))
    for low, top in zip(levels, [*levels[1:], high + 0.4], strict=True):
        lab.add(wall.box(inner, (BACK_M, deep), (low - BOARD_M, low)), textures.wood, textures.wood)
        _row(lab, wall, inner, deep, low, top - BOARD_M)


def _row(
    lab: Furnishing, wall: Wall, along: tuple[float, float], deep: float, low: float, top: float
) -> None:
    """Books and boxes side by side on a board, with gaps."""
    place = along[0] + lab.uniform(0.0, 0.1)
    while place + 0.15 < along[1]:
        wide = min(lab.uniform(0.15, 0.55), along[1] - place)
        books = lab.rng.random() < BOOKS
        high = min(lab.uniform(0.6, 0.95) * (top - low), 0.33 if books else 0.45)
        front = deep - lab.uniform(0.01, 0.08)
        paint = textures.spines if books else textures.carton
        lab.add(wall.box((place, place + wide), (BACK_M, front), (low, low + high)), paint, textures.carton)
        place += wide + lab.uniform(0.01, 0.2)


BOOKS = 0.5
"""Share of books among what stands on shelves."""


def _table(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """A table with things on it, perhaps a carton below, and a poster above."""
    deep = lab.uniform(0.6, 0.8)
    _desk(lab, wall, (start, end), (0.0, deep))
    if lab.rng.random() < 0.5:
        left = lab.uniform(start + 0.1, end - 0.6)
        box = wall.box((left, left + 0.45), (0.05, 0.45), (0.0, lab.uniform(0.25, 0.45)))
        lab.add(box, textures.carton, textures.carton)
    for left, right in ((start, 0.5 * (start + end)), (0.5 * (start + end), end)):
        _poster(lab, wall, left, right, lab.uniform(1.45, 1.75))


def _desk(
    lab: Furnishing, wall: Wall, along: tuple[float, float], deep: tuple[float, float], rows: int = 1
) -> None:
    """A table's top, legs, and rows of things on it."""
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
        sheet = wall.sheet(
            (middle - 0.5 * size[0], middle + 0.5 * size[0]),
            deep + HANG_M,
            (level * high - 0.5 * size[1], level * high + 0.5 * size[1]),
        )
        lab.surfaces.append(Surface(*sheet, _print(lab)))


def _cartons(lab: Furnishing, wall: Wall, start: float, end: float) -> None:
    """A heap of cartons, each smaller than that below, and a poster above."""
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
    """A print on a wall, somewhere between two places, and a smaller one above it."""
    wide = lab.uniform(0.6, 0.95) * (end - start)
    middle = lab.uniform(start + 0.5 * wide, end - 0.5 * wide)
    lab.hang(wall, middle, high, (wide, lab.uniform(0.35, 0.7)), _print(lab))
    lab.hang(wall, middle, high + 0.65, (0.7 * wide, lab.uniform(0.15, 0.4)), _print(lab))


def _print(lab: Furnishing) -> Paint:
    return textures.picture if lab.rng.random() < 0.7 else textures.page


def _island(lab: Furnishing, low: np.ndarray, high: np.ndarray) -> None:
    """Two tables back to back, things on both, and a board with posters between them."""
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
            lab.hang(side, place, 1.22, size, _print(lab))
