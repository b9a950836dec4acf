"""Plan of the laboratory: two rooms of 18 m × 10 m together, a door between them, and the ways of a robot through them.

The world's z axis points up; x runs along the longer side from the corner of the first room, the floor is z = 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbpf.validation.simulation.driven_paths import Drive, Move, along_corners

SIZE_M = 18.0, 10.0, 2.8
"""Of both rooms together."""

PARTITION_M = 9.9, 10.1
"""Where the wall between the rooms begins and ends along x."""

DOOR_M, LINTEL_M = (4.2, 5.8), 2.1
"""Where the door begins and ends along y, and its height."""

JAMB_M = 0.3
"""Nothing stands nearer to the door than this."""

CORNER_M = 0.95
"""The walls along y stay free so far from the rooms' corners, where the furniture of the others stands."""

BEND_M, ARM_M, RAMP_S = 1.1, 0.5, 1.0
"""How the robot drives: see `Drive`."""

TOUR_FRAMES, TURN_BACK_FRAMES = 4000, 600
RATE_HZ = 15.0

AWAY_DEG, AWAY_S = 140.0, 5.0
"""The robot looks away by this angle and for this time."""


@dataclass(frozen=True)
class Wall:
    """A wall that furniture stands against.

    Attributes:
        axis: along which it runs, 0 for x and 1 for y.
        at_m: its coordinate along the other axis.
        inwards: +1 or -1, the direction into the room along that axis.
        free_m: (K, 2) intervals along the wall where something may stand.
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

    def sheet(
        self, along: Sequence[float], deep: float, high: Sequence[float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corner, across and down of a sheet that hangs parallel to the wall and faces the room."""
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


def partition() -> np.ndarray:
    """(3, 2, 3) blocks of the wall between the rooms: on both sides of the door and above it."""
    (x0, x1), (y0, y1) = PARTITION_M, DOOR_M
    width, height = SIZE_M[1:]
    return np.array(
        [
            [[x0, 0.0, 0.0], [x1, y0, height]],
            [[x0, y1, 0.0], [x1, width, height]],
            [[x0, y0, LINTEL_M], [x1, y1, height]],
        ]
    )


ISLANDS = np.array([[[3.9, 3.8], [5.7, 6.2]], [[13.4, 4.0], [14.8, 6.0]]])
"""(2, 2, 2) where tables stand in the middle of the rooms, least and greatest x and y."""

TOUR = [
    *[(2.0, 5.0), (2.0, 2.1), (7.6, 2.1), (7.6, 7.9), (2.0, 7.9)],
    *[(2.0, 5.0), (2.0, 2.1), (7.6, 2.1), (7.6, 5.0)],
    *[(12.2, 5.0), (12.2, 2.3), (16.0, 2.3), (16.0, 7.7), (12.2, 7.7), (12.2, 5.0)],
    *[(7.6, 5.0), (7.6, 2.1), (2.0, 2.1), (2.0, 5.0)],
]
"""Once round the first room, half a round again, through the door and round the second room, back through the door and
half round the first room the other way."""


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
