"""Trajectories: poses with time stamps, and which poses of two of them belong together."""

from dataclasses import dataclass
from typing import Self, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.validation.metrics.alignment import Similarity

MAX_DIFFERENCE_NS = 10_000_000


@final
@dataclass(frozen=True)
class Trajectory:
    """Poses in order of time.

    Attributes:
        stamps_ns: (T,) integer nanoseconds; a recording without times counts its steps.
        world_from_body: (T, 7) poses [qx, qy, qz, qw, tx, ty, tz] with unit quaternions.

    Raises:
        InputError: the shapes do not fit together, a number is not finite, or time runs backwards.
    """

    stamps_ns: NDArray[np.int64]
    world_from_body: Array

    def __post_init__(self) -> None:
        if self.world_from_body.shape != (*self.stamps_ns.shape, 7) or self.stamps_ns.ndim != 1:
            shapes = f"{self.stamps_ns.shape} and {self.world_from_body.shape}"
            raise InputError(f"Expected (T,) stamps and (T, 7) poses of a trajectory, found {shapes}.")
        if not np.isfinite(self.world_from_body).all():
            row = int(np.argmin(np.isfinite(self.world_from_body).all(1)))
            raise InputError(f"Expected finite poses in a trajectory, found another in row {row} (from 0).")
        if (np.diff(self.stamps_ns) < 0).any():
            row = int(np.argmax(np.diff(self.stamps_ns) < 0)) + 1
            raise InputError(
                f"Expected a trajectory in order of time, row {row} (from 0) is before the last one."
            )

    @classmethod
    def from_planar(cls, stamps_ns: NDArray[np.int64], world_from_body: ArrayLike) -> Self:
        """Trajectory in the plane z = 0 of (T, 3) poses [theta, x, y]."""
        theta, x, y = np.moveaxis(np.asarray(world_from_body, dtype=float), -1, 0)
        zero = np.zeros_like(theta)
        return cls(stamps_ns, SE3.from_ypr(np.stack([x, y, zero], axis=-1), theta, zero, zero))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> Array:
        """(T, 3) positions of the body in the world [m]."""
        return self.world_from_body[:, 4:]

    def at(self, rows: NDArray[np.intp]) -> "Trajectory":
        """The poses of some rows, in order of time."""
        return Trajectory(self.stamps_ns[rows], self.world_from_body[rows])

    def transformed(self, similarity: Similarity) -> "Trajectory":
        """The trajectory in the world that a similarity leads to."""
        return Trajectory(self.stamps_ns, similarity.transform_poses(self.world_from_body))


def associate(
    estimate: Trajectory, reference: Trajectory, max_difference_ns: int = MAX_DIFFERENCE_NS
) -> tuple[Trajectory, Trajectory]:
    """Poses of two trajectories that belong together, paired by time.

    Each estimated pose asks for the reference pose nearest in time (the earlier of two equally near); of
    several that ask for the same one, the nearest in time gets it.

    Args:
        estimate: T_e poses.
        reference: T_r poses.
        max_difference_ns: largest difference of a pair; 0 for recordings whose stamps count steps.

    Returns:
        Estimate and reference with the same number of poses, row by row a pair.

    Raises:
        InputError: no pose has a partner.
    """
    if not len(estimate) or not len(reference):
        raise InputError("Expected trajectories with poses to associate, found an empty one.")
    wanted = _nearest(estimate.stamps_ns, reference.stamps_ns)
    difference = np.abs(estimate.stamps_ns - reference.stamps_ns[wanted])
    near = np.flatnonzero(difference <= max_difference_ns)
    if not len(near):
        raise InputError(
            f"No pose of the estimate is within {max_difference_ns * 1e-9:g} s of one of the reference "
            f"(nearest: {difference.min() * 1e-9:g} s); expected stamps of the same clock."
        )
    best_first = near[np.lexsort((difference[near], wanted[near]))]
    _, first = np.unique(wanted[best_first], return_index=True)
    rows = best_first[first]
    return estimate.at(rows), reference.at(wanted[rows])


def _nearest(stamps_ns: NDArray[np.int64], others_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    after = np.searchsorted(others_ns, stamps_ns).clip(max=len(others_ns) - 1)
    before = (after - 1).clip(min=0)
    earlier = np.abs(stamps_ns - others_ns[before]) <= np.abs(others_ns[after] - stamps_ns)
    return np.where(earlier, before, after)
