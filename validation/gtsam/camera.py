"""Batch adjustment of camera features by GTSAM: maximum a posteriori poses and landmarks given the pixels.

It uses the same measurements and noise as a filter, without sampling and all at once.
B. Triggs et al., "Bundle adjustment: a modern synthesis" (2000);
F. Dellaert and M. Kaess, "Factor graphs for robot perception" (2017). The factors:

    observations:  project(T⁻¹ l) − z ~ N(0, R), Huber's loss on request
    known points:  l ~ N(m, P), exact ones a hard constraint
    undetermined:  l ~ N(start, (d/4)² I) with d its distance, far wider than the pixels' constraint across it
    gauge:         without known points the first pose is fixed at its start; for one camera, also a distance

The distance is that from the first camera to the one farthest from it at the start. The gauge only selects one of many
equivalent solutions: it costs nothing at the optimum.

GTSAM's own projection factors are used if they are exactly our camera model: Cal3DS2 has no k₃. Factors written in
Python are evaluated all at once and returned one by one, which makes them nearly as fast as GTSAM's.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, final

import gtsam
import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.gtsam import observations, solvers

LEAST = 3  #: Least landmarks to determine a pose, and points to determine a frame.
LINE = 1e-3  #: Known points are collinear if their spread across a line is below this fraction of that along it.
POINTS = 4  #: Least points in a frame for resection.
#: Frames before the first adjustment of an incrementally built path, and growth factor until the next one.
FIRST, LONGER = 8, 1.2
SCALE, SOFT_SCALE = 1e-6, 1e-3
"""Relative standard deviation of the distance that fixes the scale, at the end and before.

Nothing else determines the scale, but a hard constraint slows down convergence along its curve.
"""
#: Standard deviation of the first pose before the end, rad and m. No solution moves it; with a hard constraint GTSAM
#: eliminates by QR, which takes up to thirty times as long as Cholesky.
HOLD = 1e-6
FINE = 1e-9  #: Relative gain that ends the iteration; landmarks with little parallax would otherwise drift on for ever.
WEAK = 0.25  #: Standard deviation of an undetermined landmark's prior, as a fraction of its distance.
_ROUNDS = 10
_FEW = 8


@final
@dataclass(frozen=True, eq=False)
class CameraState:
    """Values of all variables: world_from_camera (T, 7), and the landmarks of the table (L, 3)."""

    path: Array
    points: Array


@final
class CameraProblem:
    """Variables and factors of a recording of `frames` images; known points have a position and a covariance."""

    def __init__(
        self,
        name: str,
        frames: int,
        table: observations.ObservationTable,
        known: dict[int, tuple[Array, Array]],
        robust: float | None = None,
    ) -> None:
        self.name, self.frames, self.table, self.known, self.robust = name, frames, table, known, robust
        self.free = np.array([name not in known for name in table.names.tolist()], dtype=bool)
        self.pose_keys = [int(gtsam.symbol("x", frame)) for frame in range(frames)]
        self.point_keys = [int(gtsam.symbol("l", index)) for index in range(len(table.names))]

    @property
    def scaled(self) -> bool:
        """Whether the scale has to be fixed."""
        return not self.known and not isinstance(self.table.camera, RectifiedStereo)

    @property
    def held_keys(self) -> list[int]:
        """Variables fixed by hard constraints: known points without errors; without any known points, the first pose."""
        if not self.known:
            return [self.pose_keys[0]]
        exact = {name for name, (_, cov) in self.known.items() if not cov.any()}
        return [key for name, key in zip(self.table.names.tolist(), self.point_keys, strict=True) if name in exact]

    def graph(
        self,
        start: CameraState,
        loose: NDArray[np.bool_],
        held: Array,
        scale: float = SOFT_SCALE,
        factors: list[Any] | None = None,
    ) -> Any:
        """All factors, or those other than the observations'.

        Weak priors hold the `loose` landmarks (L,) at their positions in `start`; the gauge fixes the path `held` (T, 7), and
        the scale with a standard deviation from `SCALE`.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in self.observation_factors() if factors is None else factors:
            graph.push_back(factor)
        for name, key in zip(self.table.names.tolist(), self.point_keys, strict=True):
            if name in self.known:
                position, cov = self.known[name]
                model = solvers.noise(cov) if cov.any() else gtsam.noiseModel.Constrained.All(3)
                graph.push_back(gtsam.PriorFactorPoint3(key, position, model))
        distance = np.linalg.norm(start.points - observations.first_centres(self.table, start.path), axis=1)
        for index in np.flatnonzero(loose).tolist():
            model = gtsam.noiseModel.Isotropic.Sigma(3, WEAK * distance[index])
            graph.push_back(gtsam.PriorFactorPoint3(self.point_keys[index], start.points[index], model))
        if not self.known:
            model = gtsam.noiseModel.Isotropic.Sigma(6, HOLD) if scale > SCALE else gtsam.noiseModel.Constrained.All(6)
            graph.push_back(gtsam.PriorFactorPose3(self.pose_keys[0], solvers.SPATIAL.pose(held[0]), model))
        if self.scaled:
            distances = np.linalg.norm(SE3.translation(held) - SE3.translation(held[0]), axis=1)
            far = int(np.argmax(distances))
            if distances[far] == 0:
                raise InputError(
                    f"All initial poses of {self.name} are at one place: without known points a path has to tell the scale."
                )
            model = gtsam.noiseModel.Isotropic.Sigma(1, scale * distances[far])
            graph.push_back(gtsam.RangeFactorPose3(self.pose_keys[0], self.pose_keys[far], distances[far], model))
        return graph

    def values(self, state: CameraState) -> Any:
        """GTSAM's values of a state."""
        values = gtsam.Values()
        for key, pose in zip(self.pose_keys, state.path, strict=True):
            values.insert(key, solvers.SPATIAL.pose(pose))
        for key, point in zip(self.point_keys, state.points, strict=True):
            values.insert(key, np.asarray(point))
        return values

    def state(self, values: Any) -> CameraState:
        """The inverse of `values`; in the order of the keys, as GTSAM extracts all of a kind."""
        rows = gtsam.utilities.extractPose3(values)
        matrices = np.concatenate([rows[:, :9].reshape(-1, 3, 3), rows[:, 9:, None]], axis=-1)
        points = np.asarray(gtsam.utilities.extractVectors(values, "l"))
        return CameraState(SE3.normalise(SE3.from_matrix(matrices)), points.reshape(-1, 3))

    def explaining(self) -> AbstractContextManager[None]:
        """GTSAM's complaints in words."""
        advice = "check the measurements there, or add known points"
        return solvers.explaining(self.name, "frame", self.table.names, advice)

    def observation_factors(self) -> list[Any]:
        """One factor per row of the table, with our residual in GTSAM's order: u, right u, v of a pair."""
        camera, z = self.table.camera, self.table.z
        if isinstance(camera, RectifiedStereo):
            left = camera.camera
            pair = gtsam.Cal3_S2Stereo(left.fx, left.fy, 0.0, left.cx, left.cy, camera.baseline_m)
            return self.factors_by_row(
                lambda row, model, pose, point: gtsam.GenericStereoFactor3D(
                    gtsam.StereoPoint2(z[row, 0], z[row, 2], z[row, 1]), model, pose, point, pair
                ),
                order=[0, 2, 1],
            )
        intrinsics = camera.fx, camera.fy, 0.0, camera.cx, camera.cy
        kind: Any
        lens: Any
        if camera.distortion_model == "equidistant":
            kind = gtsam.GenericProjectionFactorCal3Fisheye
            lens = gtsam.Cal3Fisheye(*intrinsics, *camera.distortion)
        elif camera.lens.is_identity:
            kind, lens = gtsam.GenericProjectionFactorCal3_S2, gtsam.Cal3_S2(*intrinsics)
        elif camera.distortion[4] == 0.0:
            kind = gtsam.GenericProjectionFactorCal3DS2
            lens = gtsam.Cal3DS2(*intrinsics, *camera.distortion[:4])
        else:

            def evaluate(values: Any) -> observations.Residuals:
                state = self.state(values)
                return observations.reprojection(self.table, state.path, state.points)

            factor = solvers.together(evaluate)
            return self.factors_by_row(lambda row, model, pose, point: factor(row, [pose, point], model))
        return self.factors_by_row(lambda row, model, pose, point: kind(z[row], model, pose, point, lens))

    def factors_by_row(self, make: Callable[[int, Any, int, int], Any], order: list[int] | None = None) -> list[Any]:
        """A factor per row of the table, from row, noise model with its loss, and keys of pose and landmark.

        A factor's residual is ours[order]; by default ours.
        """
        models, out = dict[bytes, Any](), []
        for row, (step, index) in enumerate(zip(self.table.steps.tolist(), self.table.index.tolist(), strict=True)):
            cov = self.table.cov_z[row]
            code = cov.tobytes()
            if code not in models:
                ordered = cov if order is None else cov[np.ix_(order, order)]
                models[code] = solvers.huber(solvers.noise(ordered), self.robust)
            out.append(make(row, models[code], self.pose_keys[step], self.point_keys[index]))
        return out


class Adjusted(NamedTuple):
    """An optimum, with its factors."""

    problem: CameraProblem  #: its problem, without the landmarks that had to be left out.
    values: Any  #: GTSAM's.
    graph: Any  #: likewise.
    loose: NDArray[np.bool_]  #: (L,) landmarks with a weak prior.
    iterations: int  #: total number.
    converged: bool  #: whether it converged.

    @property
    def state(self) -> CameraState:
        """The optimum in our storage."""
        return self.problem.state(self.values)


def adjust(
    problem: CameraProblem, start: CameraState, tolerance: float = FINE, on_iteration: solvers.OnMisfit | None = None
) -> Adjusted:
    """Levenberg-Marquardt, a few rough steps at a time until undetermined landmarks are identified.

    Those of undetermined depth get a weak prior. One drawn into its camera by an outlier is left out: there it would explain
    any pixel, and block convergence. Raises InputError: a variable is not determined; it is named.
    """

    def run(graph: Any, state: CameraState, tolerance: float) -> tuple[Any, int, bool]:
        most = _FEW if tolerance == solvers.ROUGH else solvers.ITERATIONS
        with problem.explaining():
            return solvers.levenberg_marquardt(graph, problem.values(state), tolerance, most, on_iteration)

    state, weak, total, loose = start, start, 0, np.zeros(len(start.points), dtype=bool)
    for round_ in range(_ROUNDS):
        kept = ~(problem.free & observations.collapsed(problem.table, state.path, state.points))
        if not kept.all():
            table, loose = problem.table.rows(kept[problem.table.index]), loose[kept]
            problem = CameraProblem(problem.name, problem.frames, table, problem.known, problem.robust)
            state, weak = (replace(one, points=one.points[kept]) for one in (state, weak))
        now = problem.free & observations.is_open(problem.table, state.path, state.points)
        # The first classification may be due to the start; later ones only add landmarks, so that it terminates.
        now = now if round_ < 2 else now | loose
        settled = round_ > 0 and kept.all() and bool((now == loose).all())
        if not settled:
            weak = replace(state, points=observations.place(problem.table, state.path, state.points, now))
            state, loose = weak, now
        graph = problem.graph(weak, loose, start.path)
        values, count, converged = run(graph, state, tolerance if settled else solvers.ROUGH)
        state, total = problem.state(values), total + count
        if settled and converged:
            break
    done = bool(settled and converged)
    if problem.scaled:  # Again with the scale fixed as tightly as the covariances need it.
        graph = problem.graph(weak, loose, start.path, SCALE)
        values, count, converged = run(graph, state, tolerance)
        total, done = total + count, done and converged
    return Adjusted(problem, values, graph, loose, total, done)


def covariances(found: Adjusted) -> tuple[Array, dict[int, Array]]:
    """Marginal covariances of all poses (T, 6, 6) in the right chart, and of all landmarks, each (3, 3)."""
    problem = found.problem
    poses, points, names = problem.pose_keys, problem.point_keys, problem.table.names.tolist()
    if not problem.scaled and len(poses) <= solvers.MOST_POSES:
        keys = poses, points, problem.held_keys
        of_poses, of_points = solvers.marginals_by_schur(found.graph, found.values, *keys, problem.name)
        return of_poses, dict(zip(names, of_points, strict=True))
    with problem.explaining():
        blocks = solvers.marginals(found.graph, found.values, [*poses, *points])
    return np.array(blocks[: len(poses)]), dict(zip(names, blocks[len(poses) :], strict=True))


def solve_features(
    log: FeatureLog,
    initial: InitialEstimate,
    *,
    from_known: bool = False,
    robust: float | None = None,
    marginals: bool = True,
    on_iteration: solvers.OnMisfit | None = None,
    tolerance: float = FINE,
) -> solvers.BatchSolution:
    """Solve for all poses and landmarks at once.

    Known points in view fix the world's frame. Without any, the first pose is fixed at its start, and for a single camera,
    which does not measure the scale, its distance from the camera that starts farthest from it; the covariances are then
    relative to these.

    Landmarks missing in the `initial` estimate are triangulated. With `from_known` it is initialised at the known points, and
    uses from the estimate only motions of frames with too few landmarks, see `grown`. `robust` and `marginals` are as of
    `rbpf.validation.gtsam.robot.solve`. `on_iteration` is called with the error before each iteration, also during the
    initialisation; its exceptions end the adjustment. `tolerance` is the relative gain at convergence.

    Raises InputError: a number is invalid, a landmark of the estimate is behind its camera, a frame has too few landmarks
    or is not connected by them, the known points are fewer than three or collinear, or the optimiser does not converge.
    """
    full = observations.observation_table(log)
    known = observations.known_by_name(log.known, full.names)
    problem = CameraProblem(log.name, len(log.frames), full.determined(known), known, robust)
    # Check that each frame has enough observations, frames are connected, and known points fix the world's frame.
    table, name = problem.table, problem.name
    counts = np.bincount(table.steps, minlength=problem.frames)
    if (few := np.flatnonzero(counts < LEAST)).size:
        raise InputError(
            f"Frame {few[0]} of {name} sees {counts[few[0]]} landmarks that are known or seen again, expected {LEAST}."
        )
    piece = observations.in_one_piece(table.steps, table.index, problem.frames, ~problem.free)
    if (apart := np.flatnonzero(~piece)).size:
        raise InputError(
            f"Frame {apart[0]} of {name} shares no landmark with {'the known points' if known else 'frame 0'}; leave it out."
        )
    if known:
        positions = np.array([position for position, _ in known.values()])
        if len(positions) < LEAST:
            raise InputError(f"{name} sees {len(positions)} known points, expected {LEAST} or more, or none at all.")
        across = np.linalg.svd(positions - positions.mean(0), compute_uv=False)
        if across[1] <= LINE * across[0]:
            raise InputError(f"The known points that {name} sees lie on a line; add one beside it.")
    if from_known:
        initial = grown(problem, initial, on_iteration)
    found = adjust(problem, begin(problem, initial), tolerance, on_iteration)
    if not found.converged:
        raise InputError(
            f"{name} did not converge in {found.iterations} iterations; start nearer, or ask for the robust loss."
        )
    cov_poses, cov_landmarks = covariances(found) if marginals else (np.empty((0, 6, 6)), {})
    state, names = found.state, found.problem.table.names
    return solvers.BatchSolution(
        world_from_body=state.path,
        landmarks=dict(zip(names.tolist(), state.points, strict=True)),
        cov_poses=cov_poses,
        cov_landmarks=cov_landmarks,
        error=found.graph.error(found.values),
        undetermined=sorted({*full.names.tolist()} - {*names[~found.loose].tolist()}),
    )


def begin(problem: CameraProblem, start: InitialEstimate) -> CameraState:
    """An initial state from an estimate: its landmarks, known points, and the others triangulated from its poses.

    Landmarks triangulated behind a camera are placed on their first rays. Raises InputError: one cannot be placed; it is
    named.
    """
    table, path = problem.table, np.asarray(start.world_from_body, dtype=float)
    if path.shape != (problem.frames, 7) or not np.isfinite(path).all():
        raise InputError(
            f"Expected finite initial poses {(problem.frames, 7)}, one for each frame of {problem.name}, found {path.shape}."
        )
    given = {name: mean for name, (mean, _) in problem.known.items()} | dict(start.landmarks)
    points = observations.triangulate(table, path)
    rows = [index for index, name in enumerate(table.names.tolist()) if name in given]
    points[rows] = np.array([given[int(table.names[row])] for row in rows]).reshape(-1, 3)
    points = observations.place(table, path, points, ~observations.in_front(table, path, points))
    behind = np.flatnonzero(observations.in_camera(table, path, points)[:, 2] <= 0)
    if behind.size:
        row = behind[0]
        raise InputError(
            f"Landmark {table.names[table.index[row]]} lies behind the camera in frame {table.steps[row]} of "
            f"{problem.name}, which measured it; start from another estimate."
        )
    return CameraState(path, points)


def grown(
    problem: CameraProblem, start: InitialEstimate, on_iteration: solvers.OnMisfit | None = None
) -> InitialEstimate:
    """A path that starts at the known points, built frame by frame by resection from the landmarks located so far.

    Frames with too few of them use the given path's motion; nothing else of it is used. Each time it has grown by a factor,
    landmarks are triangulated and all is adjusted, because errors would accumulate.
    """
    table, given, adjusted = problem.table, np.asarray(start.world_from_body, dtype=float), FIRST
    path, placed, points = given.copy(), ~problem.free, np.zeros((len(table.names), 3))
    points[placed] = np.array([problem.known[name][0] for name in table.names[placed].tolist()]).reshape(-1, 3)
    for step in range(problem.frames):
        seen = (table.steps == step) & placed[table.index]
        if step:
            path[step] = SE3.compose(path[step - 1], SE3.between(given[step - 1], given[step]))
        found = locate(table.rows(seen), points[np.unique(table.index[seen])])
        path[step] = path[step] if found is None else found
        if step + 1 < LONGER * adjusted:
            continue
        # Triangulate landmarks with enough baseline, and adjust all frames so far.
        adjusted, so_far = step + 1, table.rows(table.steps <= step)
        places = observations.triangulate(so_far, path)
        good = observations.in_front(so_far, path, places) & ~observations.is_open(so_far, path, places)
        good |= np.isin(so_far.names, list(problem.known))
        part = so_far.rows(good[so_far.index])
        piece = CameraProblem(problem.name, adjusted, part, problem.known, observations.HUBER)
        now = adjust(piece, begin(piece, InitialEstimate(path[:adjusted], {})), solvers.ROUGH, on_iteration)
        path[:adjusted] = now.state.path
        placed = np.isin(table.names, now.problem.table.names)
        points[placed] = now.state.points
    return InitialEstimate(path, {})


def locate(table: observations.ObservationTable, points: Array) -> Array | None:
    """Pose (7,) of one frame from four points or more, (L, 3) of its landmarks: COLMAP's P3P and consensus, refined."""
    import pycolmap

    if len(points) < POINTS:
        return None
    # In undistorted pixels: those of the same rays in a camera without distortion.
    camera = table.camera.camera if isinstance(table.camera, RectifiedStereo) else table.camera
    rays = table.bearings()
    plain = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[camera.fx, 0.0, 0.0])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = 0
    px = camera.fx * rays[:, :2] / rays[:, 2:]
    found = pycolmap.estimate_and_refine_absolute_pose(px, points[table.index], plain, options)
    if found is None or found["num_inliers"] < POINTS:
        return None
    cam_from_world = found["cam_from_world"]
    pose = np.concatenate([cam_from_world.rotation.quat, cam_from_world.translation])
    return np.asarray(SE3.inverse(SE3.normalise(pose)))
