"""`calib.txt` of a KITTI sequence."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.readers.table import parse_number
from rbpf.sensors.readers.text import line_error, read_text

ALIGNED_PX = 1e-2
"""How far intrinsics of the two cameras of a pair may differ."""


@dataclass(frozen=True)
class Projections:
    """The cameras' projections.

    Attributes:
        path: the file.
        matrices: number of a camera to its (3, 4) projection K [I | t].
        lines: number of a camera to its line.
    """

    path: Path
    matrices: dict[int, Array]
    lines: dict[int, int]

    def intrinsics(self, camera: int) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy [px].

        Raises:
            InputError: the camera is missing, or its projection is not K [I | t] with no skew.
        """
        matrix = self._matrix(camera)
        fx, fy = matrix[0, 0], matrix[1, 1]
        pinhole = np.array([[fx, 0.0, matrix[0, 2]], [0.0, fy, matrix[1, 2]], [0.0, 0.0, 1.0]])
        if not (fx > 0.0 and fy > 0.0 and np.array_equal(matrix[:, :3], pinhole)):
            problem = f"expected P{camera} to be fx 0 cx . 0 fy cy . 0 0 1 . with positive fx and fy"
            raise line_error(self.path, self.lines[camera], problem)
        return float(fx), float(fy), float(matrix[0, 2]), float(matrix[1, 2])

    def first_from_camera(self, camera: int) -> Array:
        """Pose (7,) of a camera in the frame of camera 0, to which poses refer.

        Raises:
            InputError: as `intrinsics`.
        """
        self.intrinsics(camera)
        matrix = self._matrix(camera)
        shift = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
        return np.concatenate([SE3.identity()[:4], shift])

    def baseline(self, left: int, right: int) -> float:
        """Distance [m] of the cameras of a pair.

        Raises:
            InputError: as `intrinsics`, or the pair is not rectified, or the right camera not to the right.
        """
        differ = np.subtract(self.intrinsics(left), self.intrinsics(right))
        along = float((self.first_from_camera(right) - self.first_from_camera(left))[4])
        if along == 0.0:
            problem = f"P{right} is at the place of P{left}, a baseline of zero; give the projections of two cameras"
            raise line_error(self.path, self.lines[right], problem)
        if np.abs(differ).max() > ALIGNED_PX or along <= 0.0:
            problem = f"expected P{right} to be P{left} shifted to the right, as of a rectified pair"
            raise line_error(self.path, self.lines[right], problem)
        return along

    def _matrix(self, camera: int) -> Array:
        if camera not in self.matrices:
            raise InputError(f"{self.path}: expected a line `P{camera}:` and 12 numbers, found none.")
        return self.matrices[camera]


def read_projections(path: Path, hint: str) -> Projections:
    """Read the projections; other lines are passed over.

    Args:
        path: the file.
        hint: what is expected to lie there, for the message.

    Raises:
        InputError: the file is missing, or a projection is not 12 numbers.
    """
    matrices, lines = {}, {}
    for number, line in enumerate(read_text(path, hint).splitlines(), 1):
        name, _, rest = line.partition(":")
        if name not in ("P0", "P1", "P2", "P3"):
            continue
        fields = rest.split()
        if len(fields) != 12:
            raise line_error(path, number, f"expected {name}: and 12 numbers, found {len(fields)}")
        values = [parse_number(path, number, name, field) for field in fields]
        matrices[int(name[1])] = np.reshape(values, (3, 4))
        lines[int(name[1])] = number
    return Projections(path, matrices, lines)
