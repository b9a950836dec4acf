"""Which estimated landmark is which true one, where the filter gave them no names."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from rbpf.runs.trajectory import Similarity, align

_ROUNDS = 5


def match_points(
    points: np.ndarray, truth: dict[int, np.ndarray], start: Similarity | None = None
) -> dict[int, np.ndarray]:
    """Names estimated points (M, D) by the true points, one to one, nearest in sum after a rigid alignment.

    The alignment and the matching are repeated in turn, as in iterated closest points, from `start` (a path's
    alignment in space) or the identity; the points are returned as they were, by the names found.
    """
    names = list(truth)
    true = np.array([truth[name][: points.shape[1]] for name in names])
    if not len(points) or not names:
        return {}
    moved = points if start is None else start.in_dimension(points.shape[1]).transform(points)
    for _ in range(_ROUNDS):
        distance = np.linalg.norm(moved[:, None] - true[None], axis=-1)
        rows, columns = linear_sum_assignment(distance)
        moved = align(points[rows], true[columns]).transform(points)
    return {names[column]: points[row] for row, column in zip(rows, columns, strict=True)}
