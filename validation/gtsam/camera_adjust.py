"""Optimisation of a `CameraProblem`: what it cannot do without, how it is begun, and what it is worth."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.validation.gtsam.camera_graph import SCALE, CameraProblem, CameraState
from rbpf.validation.gtsam.observations import (
    CameraEstimate,
    collapsed,
    in_camera,
    in_front,
    is_open,
    place,
    triangulate,
)
from rbpf.validation.gtsam.solvers import (
    ITERATIONS,
    MOST_POSES,
    ROUGH,
    OnIteration,
    culprit,
    levenberg_marquardt,
    marginals,
    marginals_by_schur,
)

FINE = 1e-9
"""A gain of this fraction of the error is none; landmarks without much parallax would creep on for ever."""

LEAST = 3
"""Landmarks that fix a pose, and points that fix a frame."""

LINE = 1e-3
"""Known points whose spread across a line is below this fraction of that along it lie on it."""

_ROUNDS = 10
_FEW = 8


def check_problem(problem: CameraProblem) -> None:
    """Refuses too few observations of a frame, frames apart, or known points that do not fix the world's frame.

    Raises:
        InputError: see above.
    """
    table, name = problem.table, problem.name
    counts = np.bincount(table.steps, minlength=problem.frames)
    if (few := np.flatnonzero(counts < LEAST)).size:
        raise InputError(
            f"Frame {few[0]} of {name} sees {counts[few[0]]} landmarks that are known or seen from elsewhere "
            f"too, expected {LEAST} or more; leave the frame out."
        )
    # Frames, then landmarks; the known points are in one piece with the first of them.
    known = np.flatnonzero(~problem.free) + problem.frames
    ends = np.concatenate([table.index + problem.frames, known])
    starts = np.concatenate([table.steps, np.repeat(known[:1], len(known))])
    size = problem.frames + len(table.names)
    _, piece = connected_components(csr_array((np.ones(len(ends)), (starts, ends)), shape=(size, size)), False)
    first = piece[known[0]] if known.size else piece[0]
    if (apart := np.flatnonzero(piece[: problem.frames] != first)).size:
        raise InputError(
            f"Frame {apart[0]} of {name} shares no landmark, directly or through others, with "
            f"{'the known points' if known.size else 'frame 0'}; leave it out."
        )
    if problem.known:
        positions = np.array([position for position, _ in problem.known.values()])
        if len(positions) < LEAST:
            raise InputError(f"{name} sees {len(positions)} known points, expected {LEAST} or more, or none at all.")
        spread = np.linalg.svd(positions - positions.mean(0), compute_uv=False)
        if spread[1] <= LINE * spread[0]:
            raise InputError(f"The known points that {name} sees lie on a line; add one beside it.")


class Adjusted(NamedTuple):
    """An optimum.

    Attributes:
        problem: of which it is one, without the landmarks that had to be left out.
        values: GTSAM's.
        graph: the factors there.
        loose: (L,) landmarks with a weak prior.
        iterations: in all.
        converged: whether it is one.
    """

    problem: CameraProblem
    values: Any
    graph: Any
    loose: NDArray[np.bool_]
    iterations: int
    converged: bool

    @property
    def state(self) -> CameraState:
        """The optimum in our storage."""
        return self.problem.state(self.values)

    def require_converged(self) -> None:
        """Refuses an optimum that is none."""
        if not self.converged:
            raise InputError(
                f"The batch adjustment of {self.problem.name} did not converge in {self.iterations} iterations; "
                "start it from a better estimate, or ask for the robust loss."
            )


def begin(problem: CameraProblem, start: CameraEstimate) -> CameraState:
    """A state near an estimate: its landmarks, known points, and the others triangulated from its poses.

    Landmarks that come out behind a camera are placed on their first rays.

    Raises:
        InputError: the path is none of the log's frames, or a landmark has no place in front of its cameras.
    """
    table, path = problem.table, np.asarray(start.world_from_camera, dtype=float)
    if path.shape != (problem.frames, 7) or not np.isfinite(path).all():
        raise InputError(
            f"Expected finite initial poses of shape {(problem.frames, 7)}, one for each frame of "
            f"{problem.name}, found {path.shape}."
        )
    given = {name: mean for name, (mean, _) in problem.known.items()} | start.landmarks
    points = triangulate(table, path)
    rows = [index for index, name in enumerate(table.names.tolist()) if name in given]
    points[rows] = np.array([given[int(table.names[row])] for row in rows]).reshape(-1, 3)
    points = place(table, path, points, ~in_front(table, path, points))
    behind = np.flatnonzero(in_camera(table, path, points)[:, 2] <= 0)
    if behind.size:
        row = behind[0]
        raise InputError(
            f"Landmark {table.names[table.index[row]]} lies behind the camera in frame {table.steps[row]} of "
            f"{problem.name}, which measured it; start from another estimate."
        )
    return CameraState(path, points)


def adjust(
    problem: CameraProblem, start: CameraState, tolerance: float = FINE, on_iteration: OnIteration | None = None
) -> Adjusted:
    """Levenberg-Marquardt; a few rough steps at a time, until it is clear which landmarks are undetermined.

    Those whose distance is open get a weak prior. One that an outlier has drawn into its camera is left out: there
    it would explain any pixel, and hold up all others.

    Raises:
        InputError: the measurements do not determine a variable.
    """

    def run(graph: Any, state: CameraState, tolerance: float) -> tuple[Any, int, bool]:
        most = _FEW if tolerance == ROUGH else ITERATIONS
        try:
            return levenberg_marquardt(graph, problem.values(state), tolerance, most, on_iteration)
        except RuntimeError as error:
            raise explain(problem, error) from error

    state, weak, total, loose = start, start, 0, np.zeros(len(start.points), dtype=bool)
    for round_ in range(_ROUNDS):
        kept = ~(problem.free & collapsed(problem.table, state.path, state.points))
        problem, loose = problem.part(kept), loose[kept]
        state, weak = (replace(one, points=one.points[kept]) for one in (state, weak))
        now = problem.free & is_open(problem.table, state.path, state.points)
        # The first judgement may be the start's fault; later ones only add, so that it comes to an end.
        now = now if round_ < 2 else now | loose
        settled = round_ > 0 and kept.all() and bool((now == loose).all())
        if not settled:
            weak = replace(state, points=place(problem.table, state.path, state.points, now))
            state, loose = weak, now
        graph = problem.graph(weak, loose, start.path)
        values, count, converged = run(graph, state, tolerance if settled else ROUGH)
        state, total = problem.state(values), total + count
        if settled and converged:
            break
    done = bool(settled and converged)
    if problem.scaled:  # The same with the scale held as tightly as the covariances need it.
        graph = problem.graph(weak, loose, start.path, SCALE)
        values, count, converged = run(graph, state, tolerance)
        total, done = total + count, done and converged
    return Adjusted(problem, values, graph, loose, total, done)


def covariances(found: Adjusted) -> tuple[Array, dict[int, Array]]:
    """Marginal covariances of all poses (T, 6, 6) in the right chart, and of all landmarks, each (3, 3)."""
    problem = found.problem
    poses, points, names = problem.pose_keys, problem.point_keys, problem.table.names.tolist()
    if not problem.scaled and len(poses) <= MOST_POSES:
        of_poses, of_points = marginals_by_schur(
            found.graph, found.values, poses, points, problem.held_keys, problem.name
        )
        return of_poses, dict(zip(names, of_points, strict=True))
    try:
        blocks = marginals(found.graph, found.values, [*poses, *points])
    except RuntimeError as error:
        raise explain(problem, error) from error
    return np.array(blocks[: len(poses)]), dict(zip(names, blocks[len(poses) :], strict=True))


def explain(problem: CameraProblem, error: RuntimeError) -> InputError:
    """GTSAM's complaint in words, with the variable that it names."""
    named = culprit(error)
    if named is None:
        return InputError(f"GTSAM could not solve {problem.name}: {' '.join(str(error).split())}")
    letter, index = named
    where = f"landmark {problem.table.names[index]}" if letter == "l" else f"frame {index}"
    return InputError(
        f"GTSAM could not solve {problem.name}: the measurements do not determine everything near {where}; "
        "check the measurements there, or add known points."
    )
