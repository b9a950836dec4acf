"""Least-squares alignment of point sets.

S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE Trans.
Pattern Analysis and Machine Intelligence 13(4), 1991: s, R, t of smallest Σ |y − (s R x + t)|², det R = 1.
"""

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.errors import InputError
from rbpf.lie import SE3, Array

Alignment = Literal["none", "rigid", "similarity"]


@final
@dataclass(frozen=True)
class Similarity:
    """The map x ↦ scale · rotation x + translation from the estimate's world into the reference's.

    Attributes:
        scale: reference metres per estimated metre.
        rotation: (D, D), reference_from_estimate.
        translation: (D,) [m], in the reference's world.
        unique: False where other rotations fit as well; then `rotation` turns by the smallest angle of them.
    """

    scale: float
    rotation: Array
    translation: Array
    unique: bool = True

    def transform(self, points: ArrayLike) -> Array:
        """Points (..., D) of the estimate's world in the reference's."""
        x = np.asarray(points, dtype=float)
        return self.scale * np.einsum("ij,...j->...i", self.rotation, x) + self.translation

    def transform_poses(self, world_from_body: Array) -> Array:
        """Poses (..., 7) in the estimate's world, as poses in the reference's; only for D = 3."""
        motion = np.column_stack([self.rotation, self.translation])
        turned = SE3.compose(SE3.from_matrix(motion), world_from_body)
        return np.concatenate([turned[..., :4], self.transform(world_from_body[..., 4:])], axis=-1)


def align(estimate_points: ArrayLike, reference_points: ArrayLike, with_scale: bool = False) -> Similarity:
    """Similarity that brings estimated points closest to the reference, Umeyama (1991) (39)-(43).

    Too few points, and points on one line (D = 3) or all in one place, leave the rotation undetermined
    without changing the residual: the smallest fitting rotation is returned and `unique` is False. The scale
    of an estimate that lies in one place is 1.

    Args:
        estimate_points: (N, D) with D = 2 or 3 and N >= 1 [m].
        reference_points: (N, D), the same points in the same order [m].
        with_scale: estimate the scale too; otherwise it is 1.

    Raises:
        InputError: the shapes do not fit together, there is no point, or a coordinate is not finite.
    """
    x, y = _checked(estimate_points, reference_points)
    centre_x, centre_y = x.mean(0), y.mean(0)
    dx, dy = x - centre_x, y - centre_y
    cov_yx = np.einsum("ni,nj->ij", dy, dx) / len(x)
    u, singular, vt = np.linalg.svd(cov_yx)
    rank = int((singular > _rounding(x, y, dx, dy)).sum())
    rotation = _closest_rotation(u, vt.T, rank)
    variance = np.square(dx).sum() / len(x)
    scale = float((rotation * cov_yx).sum() / variance) if with_scale and rank else 1.0
    translation = centre_y - scale * np.einsum("ij,j->i", rotation, centre_x)
    return Similarity(scale, rotation, translation, unique=rank >= x.shape[1] - 1)


def fit(alignment: Alignment | Similarity, estimate_points: Array, reference_points: Array) -> Similarity:
    """The alignment asked for: none, the best rigid motion or similarity, or one that is already known.

    Raises:
        InputError: the name is another one, or `align` refuses the points.
    """
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
        raise InputError(
            f"Expected two arrays of N >= 1 points in 2-D or 3-D, found shapes {x.shape} and {y.shape}."
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError("Expected points with finite coordinates to align.")
    return x, y


def _rounding(x: Array, y: Array, dx: Array, dy: Array) -> float:
    # What rounding of coordinates far from the origin leaves in the cross-covariance.
    spread_x, spread_y = (float(np.sqrt(np.square(d).sum(1).mean())) for d in (dx, dy))
    noise = float(np.abs(x).max()) * spread_y + float(np.abs(y).max()) * spread_x
    return 32.0 * float(np.finfo(float).eps) * noise


def _closest_rotation(u: Array, v: Array, rank: int) -> Array:
    # Within the null spaces every orthogonal matrix fits; the one of largest trace turns least.
    left, _, right_t = np.linalg.svd(np.einsum("ki,kj->ij", u[:, rank:], v[:, rank:]))
    u = np.concatenate([u[:, :rank], np.einsum("ij,jk->ik", u[:, rank:], left)], axis=1)
    v = np.concatenate([v[:, :rank], np.einsum("ij,kj->ik", v[:, rank:], right_t)], axis=1)
    signs = np.ones(len(u))
    signs[-1] = np.sign(np.linalg.det(u) * np.linalg.det(v))
    return np.asarray(np.einsum("ij,j,kj->ik", u, signs, v))
