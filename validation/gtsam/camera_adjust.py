"""Optimisation of a `CameraProblem`, and how it is begun from a path and some landmarks."""

import re
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.validation.gtsam.camera_data import CameraEstimate, in_camera
from rbpf.validation.gtsam.camera_graph import SCALE, CameraProblem, CameraState
from rbpf.validation.gtsam.camera_points import collapsed, in_front, is_open, place, triangulate
from rbpf.validation.gtsam.schur import MOST_POSES, marginals_by_schur
from rbpf.validation.gtsam.solvers import (
    ITERATIONS,
    ROUGH,
    OnIteration,
    levenberg_marquardt,
    marginals,
)

FINE = 1e-9
"""A gain of this fraction of the error is none; landmarks without much parallax would creep on for ever."""

_ROUNDS = 10
_FEW = 8
_SYMBOL = re.compile(r"\(Symbol: ([xlv])(\d+)\)")


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
    path = path[problem.shared]
    given = {name: mean for name, (mean, _) in problem.known.items()} | start.landmarks
    points = triangulate(table, path)
    rows = [index for index, name in enumerate(table.names.tolist()) if name in given]
    points[rows] = np.array([given[int(table.names[row])] for row in rows]).reshape(-1, 3)
    front = in_front(table, path, points)
    points = place(table, path, points, ~front)
    _require_front(problem, path, points)
    return CameraState(path, points, _velocities(problem, path))


def adjust(
    problem: CameraProblem,
    start: CameraState,
    tolerance: float = FINE,
    on_iteration: OnIteration | None = None,
) -> Adjusted:
    """Levenberg-Marquardt; a few rough steps at a time, until it is clear which landmarks are undetermined.

    Those whose distance is open get a weak prior. One that an outlier has drawn into its camera is left out: there
    it would explain any pixel, and hold up all others.

    Raises:
        InputError: the measurements do not determine a variable.
    """
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
        values, count, converged = _run(problem, graph, state, tolerance if settled else ROUGH, on_iteration)
        state, total = problem.state(values), total + count
        if settled and converged:
            break
    found = Adjusted(problem, values, graph, loose, total, bool(settled and converged))
    if problem.scaled:
        found = _scaled(found, weak, start.path, tolerance, on_iteration)
    return found


def _scaled(
    found: Adjusted, weak: CameraState, held: Array, tolerance: float, on_iteration: OnIteration | None
) -> Adjusted:
    # The same with the scale held as tightly as the covariances need it.
    graph = found.problem.graph(weak, found.loose, held, SCALE)
    values, count, converged = _run(found.problem, graph, found.state, tolerance, on_iteration)
    total = found.iterations + count
    return Adjusted(found.problem, values, graph, found.loose, total, found.converged and converged)


def _run(
    problem: CameraProblem,
    graph: Any,
    state: CameraState,
    tolerance: float,
    on_iteration: OnIteration | None,
) -> tuple[Any, int, bool]:
    try:
        most = _FEW if tolerance == ROUGH else ITERATIONS
        return levenberg_marquardt(graph, problem.values(state), tolerance, most, on_iteration)
    except RuntimeError as error:
        raise explain(problem, error) from error


def require_converged(found: Adjusted) -> None:
    """Refuses an optimum that is none."""
    if not found.converged:
        raise InputError(
            f"The batch adjustment of {found.problem.name} did not converge in {found.iterations} iterations; "
            "start it from a better estimate, or ask for the robust loss."
        )


def covariances(found: Adjusted) -> tuple[Array, dict[int, Array]]:
    """Marginal covariances of all poses (T, 6, 6) in the right chart, and of all landmarks, each (3, 3)."""
    problem = found.problem
    poses = dict.fromkeys(problem.pose_keys)
    if not problem.scaled and problem.velocity is None and len(poses) <= MOST_POSES:
        names = problem.table.names.tolist()
        of_poses, of_points = marginals_by_schur(
            found.graph, found.values, list(poses), problem.point_keys, problem.held_keys, problem.name
        )
        return of_poses[problem.slots], dict(zip(names, of_points, strict=True))
    keys = [*poses, *problem.point_keys]
    try:
        blocks = dict(zip(keys, marginals(found.graph, found.values, keys), strict=True))
    except RuntimeError as error:
        raise explain(problem, error) from error
    names = zip(problem.table.names.tolist(), problem.point_keys, strict=True)
    return np.array([blocks[key] for key in problem.pose_keys]), {name: blocks[key] for name, key in names}


def explain(problem: CameraProblem, error: RuntimeError) -> InputError:
    """GTSAM's complaint in words, with the variable that it names."""
    symbol = _SYMBOL.search(str(error))
    if symbol is None:
        return InputError(f"GTSAM could not solve {problem.name}: {' '.join(str(error).split())}")
    index = int(symbol[2])
    place = f"landmark {problem.table.names[index]}" if symbol[1] == "l" else f"frame {index}"
    return InputError(
        f"GTSAM could not solve {problem.name}: the measurements do not determine everything near {place}; "
        "check the measurements there, or add known points."
    )


def _velocities(problem: CameraProblem, path: Array) -> Array:
    if problem.velocity is None:
        return np.empty((0, 6))
    first = np.unique(problem.slots, return_index=True)[1]
    steps = SE3.local(path[first][:-1], path[first][1:]) / (1e-9 * np.diff(problem.times))[:, None]
    return np.concatenate([steps, steps[-1:]])[problem.slots]


def _require_front(problem: CameraProblem, path: Array, points: Array) -> None:
    behind = np.flatnonzero(in_camera(problem.table, path, points)[:, 2] <= 0)
    if behind.size:
        row = behind[0]
        raise InputError(
            f"Landmark {problem.table.names[problem.table.index[row]]} lies behind the camera in frame "
            f"{problem.table.steps[row]} of {problem.name}, which measured it; start from another estimate."
        )
