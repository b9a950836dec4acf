"""Pose of one image from points whose places are known, from nowhere or from near by.

C.-P. Lu, G. Hager and E. Mjolsness, "Fast and globally convergent pose estimation from video images" (2000).
"""

from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from rbpf.lie import SE3, Array
from rbpf.validation.gtsam.camera_data import Sightings
from rbpf.validation.gtsam.camera_factors import evaluate_sightings
from rbpf.validation.gtsam.camera_points import HUBER

OUTLIER = 5.0
"""A sighting farther off is left out, in standard deviations."""

_LEAST = 4
_ITERATIONS = 30
_DAMPING = 1e-4
_ALIGNMENTS = 100
_CANDIDATES = 6
_SETTLED = 1e-6


class Resected(NamedTuple):
    """Pose (7,), its covariance (6, 6) in the right chart with the points exact, and its loss."""

    pose: Array
    cov: Array
    loss: float


def resect(table: Sightings, points: Array, near: Array, info: Array) -> Resected:
    """Pose with Huber's loss, and then once more without the outliers, whose pull Huber only limits.

    A weak prior stands in for what the image leaves open.

    Args:
        table: sightings of one frame.
        points: (L, 3) places of its landmarks.
        near: (7,) world_from_camera, where it starts and where the prior has its mean.
        info: (6, 6) information of the prior.
    """
    found = _descend(table, points, near, near, info)
    inlier = _strain(table, points, found.pose) < OUTLIER
    if inlier.all() or inlier.sum() < _LEAST:
        return found
    part = table.rows(inlier)
    kept = points[np.searchsorted(table.names, part.names)]
    again = _descend(part, kept, found.pose, near, info)
    return again._replace(loss=_terms(table, points, again.pose, near, info)[0])


def _descend(table: Sightings, points: Array, pose: Array, near: Array, info: Array) -> Resected:
    # Levenberg-Marquardt from the pose, with the prior around another one.
    damping = _DAMPING
    cost, gradient, hessian = _terms(table, points, pose, near, info)
    for _ in range(_ITERATIONS):
        step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
        moved = SE3.retract(pose, step)
        terms = _terms(table, points, moved, near, info)
        gain = cost - terms[0]
        damping *= 0.1 if gain >= 0 else 10
        if gain >= 0:
            pose, (cost, gradient, hessian) = moved, terms
        if abs(gain) <= _SETTLED * (1.0 + cost):
            break
    return Resected(pose, np.asarray(np.linalg.inv(hessian)), cost)


def locate(table: Sightings, points: Array) -> Resected:
    """Pose of a frame of which nothing is known, from four points or more.

    From 24 orientations all around, each is improved by orthogonal iteration, and the best ones by `resect`.

    Args:
        table: sightings of one frame.
        points: (L, 3) places of its landmarks.
    """
    aligned = _align(table.bearings(), points[table.index])
    losses = [_terms(table, points, pose, pose, np.zeros((6, 6)))[0] for pose in aligned]
    best = np.argsort(losses, kind="stable")[:_CANDIDATES]
    tiny = 1e-9 * np.eye(6)
    return min((resect(table, points, aligned[i], tiny) for i in best), key=lambda found: found.loss)


def _strain(table: Sightings, points: Array, pose: Array) -> Array:
    # Distance (K,) of each sighting from where it should be, in standard deviations.
    residuals = evaluate_sightings(table, pose[None], points)[0]
    square = np.einsum("ki,ki->k", residuals, np.linalg.solve(table.cov_z, residuals[..., None])[..., 0])
    return np.sqrt(square)


def _terms(
    table: Sightings, points: Array, pose: Array, near: Array, info: Array
) -> tuple[float, Array, Array]:
    # Loss, gradient and Gauss-Newton Hessian; one landmark's residual weighs as Huber's loss of its norm.
    residuals, (slope, _) = evaluate_sightings(table, pose[None], points)
    whiten = np.linalg.inv(np.linalg.cholesky(table.cov_z))
    e, j = np.einsum("kij,kj->ki", whiten, residuals), whiten @ slope
    norm = np.linalg.norm(e, axis=1)
    weight = np.minimum(1.0, HUBER / np.maximum(norm, HUBER))
    loss = np.where(norm <= HUBER, 0.5 * norm**2, HUBER * (norm - 0.5 * HUBER)).sum()
    off = SE3.local(near, pose)
    gradient = np.einsum("kij,ki,k->j", j, e, weight) + info @ off
    hessian = np.einsum("kia,kib,k->ab", j, j, weight) + info
    return float(loss + 0.5 * off @ info @ off), gradient, hessian


def _align(rays: Array, points: Array) -> Array:
    # Poses (24, 7): of rotation R = camera_from_world the translation t is linear, and of both the points' nearest
    # places on their rays, from which R follows by an alignment.
    onto = rays[:, :, None] * rays[:, None]
    across = np.eye(3) - onto
    inverse = np.linalg.inv(across.mean(0))
    centred = points - points.mean(0)
    turn = _orientations()
    for _ in range(_ALIGNMENTS):
        turned = np.einsum("nij,kj->nki", turn, points)
        shift = -np.einsum("ij,kjl,nkl->ni", inverse, across, turned) / len(points)
        nearest = np.einsum("kij,nkj->nki", onto, turned + shift[:, None])
        u, _, vt = np.linalg.svd(np.einsum("nki,kj->nij", nearest - nearest.mean(1, keepdims=True), centred))
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        turn = u @ vt
    shift = -np.einsum("ij,kjl,nkl->ni", inverse, across, np.einsum("nij,kj->nki", turn, points)) / len(
        points
    )
    return SE3.inverse(SE3.from_matrix(np.concatenate([turn, shift[..., None]], axis=-1)))


def _orientations() -> Array:
    # The 24 rotations of a cube.
    signed = [np.eye(3)[list(p)] * s for p in permutations(range(3)) for s in product([1.0, -1.0], repeat=3)]
    return np.array([matrix for matrix in signed if np.linalg.det(matrix) > 0])
