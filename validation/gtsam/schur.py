"""Marginal covariances of a camera's poses and landmarks from the reduced system of the poses.

Landmarks see each other only through the poses. With the information matrix in blocks

    H = [ H_pp  H_pl ]      S = H_pp − H_pl H_ll⁻¹ H_lp,     Σ_pp = S⁻¹
        [ H_lp  H_ll ]      Σ_ll = H_ll⁻¹ + H_ll⁻¹ H_lp Σ_pp H_pl H_ll⁻¹

H_ll is block-diagonal, so that a landmark's fraction costs the square of the poses that see it. (B. Triggs et al., "Bundle
adjustment: a modern synthesis", 2000, §6.) Information squares the condition of the problem: this is for problems whose
scale is measured, well or badly, not for those where a stiff prior holds it.
"""

from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array

from rbpf.errors import InputError
from rbpf.lie import Array

POSE, POINT = 6, 3

MOST_POSES = 1_500
"""Whose dense reduced system is taken: 9,000 unknowns, 650 MB."""


def marginals_by_schur(
    graph: Any, values: Any, poses: list[int], points: list[int], held: list[int], name: str
) -> tuple[Array, Array]:
    """Covariances (P, 6, 6) of poses and (L, 3, 3) of points, in GTSAM's chart; zero for what is held.

    Args:
        graph: nonlinear factors between poses and points; no others.
        values: the optimum.
        poses: P keys.
        points: L keys.
        held: those of them that a hard constraint holds, each by itself.
        name: of the recording.

    Raises:
        InputError: the measurements do not determine something.
    """
    sizes = dict.fromkeys(poses, POSE) | dict.fromkeys(points, POINT)
    free = [key for key in sorted(sizes) if key not in held]
    jacobian = _jacobian(graph.linearize(values), sizes, free)
    of_pose = np.repeat([sizes[key] == POSE for key in free], [sizes[key] for key in free])
    cov_poses, cov_points = _reduced(jacobian[:, of_pose], jacobian[:, ~of_pose], name)
    found = dict(zip((key for key in free if sizes[key] == POSE), cov_poses, strict=True))
    found |= dict(zip((key for key in free if sizes[key] == POINT), cov_points, strict=True))
    exact = np.zeros((POSE, POSE)), np.zeros((POINT, POINT))
    return (
        np.array([found.get(key, exact[0]) for key in poses]),
        np.array([found.get(key, exact[1]) for key in points]).reshape(-1, POINT, POINT),
    )


def _jacobian(linear: Any, sizes: dict[int, int], free: list[int]) -> csc_array:
    """Whitened rows, by the free keys in ascending order."""
    rows, columns, entries = linear.sparseJacobian_()
    keys = sorted(sizes)
    widths = [sizes[key] for key in keys]
    count = sum(widths)
    kept = np.append(np.repeat(np.isin(keys, free), widths), False)  # the last column is the residual
    inside = kept[columns.astype(int) - 1]
    at = rows[inside].astype(int) - 1, columns[inside].astype(int) - 1
    shape = (int(rows.max()), count)
    return csc_array((entries[inside], at), shape=shape)[:, kept[:count]]


def _reduced(of_poses: csc_array, of_points: csc_array, name: str) -> tuple[Array, Array]:
    count = of_points.shape[1] // POINT
    blocks = _diagonal(of_points, count)
    try:
        inverse = np.linalg.inv(blocks)
    except np.linalg.LinAlgError as error:
        raise _undetermined(name) from error
    first = np.repeat(POINT * np.arange(count), POINT * POINT)
    within = np.tile(np.indices((POINT, POINT)).reshape(2, -1), count)
    size = POINT * count
    spread = csc_array((inverse.ravel(), (first + within[0], first + within[1])), shape=(size, size))
    seen = csc_array(of_points.T @ of_poses)
    weights = csc_array(spread @ seen)
    schur = (of_poses.T @ of_poses).toarray() - (seen.T @ weights).toarray()
    cov = _inverse(schur, name)
    covs = np.empty((count, POINT, POINT))
    rows = weights.tocsr()
    for index in range(count):
        part = rows[POINT * index : POINT * (index + 1)]
        used = np.unique(part.indices)
        dense = part[:, used].toarray()
        covs[index] = inverse[index] + dense @ cov[np.ix_(used, used)] @ dense.T
    poses = np.arange(cov.shape[0] // POSE)
    return cov.reshape(poses.size, POSE, -1, POSE)[poses, :, poses], covs


def _diagonal(of_points: csc_array, count: int) -> Array:
    """The 3×3 blocks of H_ll."""
    full = (of_points.T @ of_points).tocoo()
    blocks = np.zeros((count, POINT, POINT))
    np.add.at(blocks, (full.row // POINT, full.row % POINT, full.col % POINT), full.data)
    return blocks


def _inverse(matrix: Array, name: str) -> Array:
    """Of a positive definite matrix, scaled to a diagonal of ones."""
    diagonal = np.diagonal(matrix)
    if not (diagonal > 0.0).all():
        raise _undetermined(name)
    scale = 1.0 / np.sqrt(diagonal)
    try:
        factor = cho_factor(scale[:, None] * matrix * scale, lower=True)
    except np.linalg.LinAlgError as error:
        raise _undetermined(name) from error
    return np.asarray(scale[:, None] * cho_solve(factor, np.eye(len(matrix))) * scale)


def _undetermined(name: str) -> InputError:
    return InputError(
        f"The measurements of {name} do not determine all poses and landmarks, so that they have no covariance; "
        "add known points, or leave out what is seen too seldom."
    )
