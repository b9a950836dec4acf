"""Trajectories: poses with time stamps, their association in time, alignment and files.

S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE Trans.
Pattern Analysis and Machine Intelligence 13(4), 1991: s, R, t of smallest Σ |y − (s R x + t)|², det R = 1.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbpf.arrays import RowByRow
from rbpf.core.checkpoint import numbers, require, stamps
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Array
from rbpf.runs.files import write_text
from rbpf.sensors.readers.images.poses import normalised
from rbpf.sensors.readers.images.rectification import nearest_in_time
from rbpf.sensors.readers.text import read_columns

MAX_DIFFERENCE_NS = 10_000_000
Alignment = Literal["none", "rigid", "similarity"]


@final
@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · rotation x + translation from the estimate's world into the reference's, of D = 2 or 3 dimensions."""

    scale: float
    rotation: Array
    translation: Array

    def transform(self, points: ArrayLike) -> Array:
        """Points (..., D) of the estimate's world in the reference's."""
        x = np.asarray(points, dtype=float)
        return self.scale * np.einsum("ij,...j->...i", self.rotation, x) + self.translation

    def in_dimension(self, dim: int) -> "Similarity":
        """The same for points of the plane z = 0 where `dim` is 2, for a similarity that keeps that plane."""
        return Similarity(self.scale, self.rotation[:dim, :dim], self.translation[:dim])

    def transform_poses(self, world_from_body: Array) -> Array:
        """Poses (..., 7) in the estimate's world, as poses in the reference's; only for D = 3."""
        turned = SE3.compose(SE3.from_matrix(np.column_stack([self.rotation, self.translation])), world_from_body)
        return np.concatenate([turned[..., :4], self.transform(world_from_body[..., 4:])], axis=-1)


@final
@dataclass(frozen=True)
class Trajectory(RowByRow):
    """Poses in order of time. Raises InputError: shapes do not fit, numbers are not finite, time runs backwards."""

    stamps_ns: NDArray[np.int64]  #: (T,) integer nanoseconds; a recording without times counts its steps.
    world_from_body: Array  #: (T, 7) poses [qx, qy, qz, qw, tx, ty, tz] with unit quaternions.

    def __post_init__(self) -> None:
        require("a trajectory", vars(self), {"stamps_ns": stamps("T"), "world_from_body": numbers("T", 7)})

    @classmethod
    def from_planar(cls, stamps_ns: NDArray[np.int64], world_from_body: ArrayLike) -> Self:
        """Trajectory in the plane z = 0 of (T, 3) poses [theta, x, y]."""
        theta, x, y = np.moveaxis(np.asarray(world_from_body, dtype=float), -1, 0)
        zero = np.zeros_like(theta)
        return cls(stamps_ns, SE3.from_ypr(np.stack([x, y, zero], axis=-1), theta, zero, zero))

    @property
    def positions(self) -> Array:
        """(T, 3) positions of the body in the world [m]."""
        return self.world_from_body[:, 4:]

    @property
    def spread(self) -> float:
        """Root mean square distance of the positions from their centre [m]."""
        return float(np.sqrt(np.square(self.positions - self.positions.mean(axis=0)).sum(axis=1).mean()))

    def transformed(self, similarity: Similarity) -> "Trajectory":
        """The trajectory transformed by a similarity."""
        return Trajectory(self.stamps_ns, similarity.transform_poses(self.world_from_body))


def in_space(stamps_ns: NDArray[np.int64], poses: Array) -> Trajectory:
    """Poses (T, E) of SE2 or SE3 as a trajectory in space."""
    if poses.shape[1] == SE2.size:
        return Trajectory.from_planar(stamps_ns, poses)
    return Trajectory(stamps_ns, poses)


def associate(
    estimate: Trajectory, reference: Trajectory, max_difference_ns: int = MAX_DIFFERENCE_NS
) -> tuple[Trajectory, Trajectory]:
    """Associates the poses of two trajectories by time; returns both with the paired poses row by row.

    Each estimated pose is paired with the reference pose nearest in time (the earlier in a tie), within `max_difference_ns`,
    0 for stamps that count steps; of several with the same reference pose, the nearest in time is kept.
    Raises InputError: no pose has a partner.
    """
    if not len(estimate) or not len(reference):
        raise InputError("Expected trajectories with poses to associate, found an empty one.")
    wanted, difference = nearest_in_time(estimate.stamps_ns, reference.stamps_ns)
    near = np.flatnonzero(difference <= max_difference_ns)
    if not len(near):
        raise InputError(
            f"No pose of the estimate is within {max_difference_ns * 1e-9:g} s of one of the reference "
            f"(nearest: {difference.min() * 1e-9:g} s); expected stamps of the same clock."
        )
    best_first = near[np.lexsort((difference[near], wanted[near]))]
    _, first = np.unique(wanted[best_first], return_index=True)
    rows = best_first[first]
    return estimate.take(rows), reference.take(wanted[rows])


def align(estimate_points: ArrayLike, reference_points: ArrayLike, with_scale: bool = False) -> Similarity:
    """Similarity that brings estimated points (N, D) closest to the reference (N, D), D = 2 or 3, Umeyama (1991) (39)-(43).

    Too few points, collinear points (D = 3) or coinciding points leave the rotation undetermined without changing the
    residual: the smallest fitting rotation is returned. The scale of an estimate at a single point is 1, as without
    `with_scale`. Raises InputError: shapes do not fit, or a coordinate is not finite.
    """
    x, y = _checked(estimate_points, reference_points)
    centre_x, centre_y = x.mean(0), y.mean(0)
    dx, dy = x - centre_x, y - centre_y
    cov_yx = np.einsum("ni,nj->ij", dy, dx) / len(x)
    u, singular, vt = np.linalg.svd(cov_yx)
    # Rounding error of the cross-covariance, for coordinates far from the origin.
    spread_x, spread_y = (float(np.sqrt(np.square(d).sum(1).mean())) for d in (dx, dy))
    noise = float(np.abs(x).max()) * spread_y + float(np.abs(y).max()) * spread_x
    rank = int((singular > 32.0 * float(np.finfo(float).eps) * noise).sum())
    # Within the null spaces every orthogonal matrix fits; the one of largest trace has the smallest rotation.
    v = vt.T
    left, _, right_t = np.linalg.svd(np.einsum("ki,kj->ij", u[:, rank:], v[:, rank:]))
    u = np.concatenate([u[:, :rank], np.einsum("ij,jk->ik", u[:, rank:], left)], axis=1)
    v = np.concatenate([v[:, :rank], np.einsum("ij,kj->ik", v[:, rank:], right_t)], axis=1)
    signs = np.ones(len(u))
    signs[-1] = np.sign(np.linalg.det(u) * np.linalg.det(v))
    rotation = np.asarray(np.einsum("ij,j,kj->ik", u, signs, v))
    variance = np.square(dx).sum() / len(x)
    scale = float((rotation * cov_yx).sum() / variance) if with_scale and rank else 1.0
    translation = centre_y - scale * np.einsum("ij,j->i", rotation, centre_x)
    return Similarity(scale, rotation, translation)


def fit(alignment: Alignment | Similarity, estimate_points: Array, reference_points: Array) -> Similarity:
    """The requested alignment: none, the best rigid motion or similarity, or a given one."""
    if isinstance(alignment, Similarity):
        return alignment
    if alignment not in ("none", "rigid", "similarity"):
        raise InputError(f"Expected the alignment none, rigid or similarity, found {alignment!r}.")
    if alignment == "none":
        x, _ = _checked(estimate_points, reference_points)
        return Similarity(1.0, np.eye(x.shape[1]), np.zeros(x.shape[1]))
    return align(estimate_points, reference_points, with_scale=alignment == "similarity")


def _checked(estimate_points: ArrayLike, reference_points: ArrayLike) -> tuple[Array, Array]:
    x, y = np.asarray(estimate_points, dtype=float), np.asarray(reference_points, dtype=float)
    if x.shape != y.shape or x.ndim != 2 or x.shape[1] not in (2, 3) or not len(x):
        raise InputError(f"Expected two arrays of N >= 1 points in 2-D or 3-D, found shapes {x.shape} and {y.shape}.")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("Expected points with finite coordinates to align.")
    return x, y


TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def read_tum(path: Path) -> Trajectory:
    """Trajectory of a file in TUM format; quaternions are scaled to unit length. An InputError names file and line."""
    table = read_columns(path, TUM_COLUMNS, "a trajectory in TUM format")
    poses = normalised(np.hstack([table.block("qx", "qw"), table.block("tx", "tz")]), table.error)
    return Trajectory(table.stamps_ns(), poses)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Writes a trajectory in TUM format, with every digit; the file appears under its name when complete."""
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.world_from_body.tolist(), strict=True)
    lines = ["# " + " ".join(TUM_COLUMNS)]
    for stamp_ns, pose in rows:
        seconds, fraction = divmod(abs(stamp_ns), 10**9)
        stamp = f"{'-' if stamp_ns < 0 else ''}{seconds}.{fraction:09d}"
        lines.append(" ".join([stamp, *map(repr, pose[4:]), *map(repr, pose[:4])]))
    write_text(path, "\n".join(lines) + "\n")


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Writes a trajectory in KITTI format, with every digit and without times; the file appears when it is complete."""
    rows = SE3.matrix(trajectory.world_from_body)[:, :3].reshape(-1, 12).tolist()
    write_text(path, "".join(" ".join(map(repr, row)) + "\n" for row in rows))
