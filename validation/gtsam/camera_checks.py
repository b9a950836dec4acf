"""What a batch adjustment of camera features cannot do without, one sentence for each."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.validation.gtsam.camera_graph import CameraProblem

LEAST = 3
"""Landmarks that fix a pose, and points that fix a frame."""
LINE = 1e-3
"""Known points whose spread across a line is below this fraction of that along it lie on it."""


def check_robust(robust: float | None) -> None:
    """Refuses a threshold that is not positive."""
    if robust is not None and not robust > 0:
        raise InputError(f"Expected a robust threshold above 0 standard deviations, found {robust}.")


def acceleration(velocity: ArrayLike | None) -> Array | None:
    """The standard deviation of the acceleration, refused unless it is six positive numbers."""
    if velocity is None:
        return None
    std = np.asarray(velocity, dtype=float)
    if std.shape != (6,) or not (np.isfinite(std).all() and (std > 0).all()):
        raise InputError(f"Expected six positive standard deviations of the acceleration, found {velocity}.")
    return std


def check_problem(problem: CameraProblem) -> None:
    """Refuses too few sightings of a frame, frames apart, or known points that do not fix the world's frame.

    Raises:
        InputError: see above.
    """
    if problem.velocity is None:
        _check_frames(problem)
        _check_connected(problem)
    elif len(problem.times) < 2:
        raise InputError(f"{problem.name} has frames of one time only; a velocity needs two or more times.")
    if problem.known:
        _check_known(problem)


def _check_frames(problem: CameraProblem) -> None:
    counts = np.bincount(problem.table.steps, minlength=problem.frames)
    if (few := np.flatnonzero(counts < LEAST)).size:
        raise InputError(
            f"Frame {few[0]} of {problem.name} sees {counts[few[0]]} landmarks that are known or seen from elsewhere "
            f"too, expected {LEAST} or more; leave the frame out, or give the velocity's noise."
        )


def _check_connected(problem: CameraProblem) -> None:
    # Frames, then landmarks; the known points are in one piece with the first of them.
    table = problem.table
    known = np.flatnonzero(~problem.free) + problem.frames
    ends = np.concatenate([table.index + problem.frames, known])
    starts = np.concatenate([table.steps, np.repeat(known[:1], len(known))])
    size = problem.frames + len(table.names)
    _, piece = connected_components(
        csr_array((np.ones(len(ends)), (starts, ends)), shape=(size, size)), False
    )
    first = piece[known[0]] if known.size else piece[0]
    if (apart := np.flatnonzero(piece[: problem.frames] != first)).size:
        raise InputError(
            f"Frame {apart[0]} of {problem.name} shares no landmark, directly or through others, with "
            f"{'the known points' if known.size else 'frame 0'}; leave it out, or give the velocity's noise."
        )


def _check_known(problem: CameraProblem) -> None:
    positions = np.array([position for position, _ in problem.known.values()])
    if len(positions) < LEAST:
        raise InputError(
            f"{problem.name} sees {len(positions)} known points, expected {LEAST} or more, or none at all."
        )
    spread = np.linalg.svd(positions - positions.mean(0), compute_uv=False)
    if spread[1] <= LINE * spread[0]:
        raise InputError(f"The known points that {problem.name} sees lie on a line; add one beside it.")
