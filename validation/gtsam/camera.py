"""Batch adjustment of camera features by GTSAM: all poses and landmarks that explain the pixels best.

The same measurements and the same noise as a filter had, without its samples and without its order in time.
B. Triggs et al., "Bundle adjustment: a modern synthesis" (2000);
F. Dellaert and M. Kaess, "Factor graphs for robot perception" (2017).

An initial estimate from scratch has the first camera from known points, then goes frame by frame: a frame's pose is
found from the landmarks placed so far; then the landmarks that it sees are triangulated, and placed once their parallax
tells their distance. From time to time all is adjusted, because errors would grow else.
"""

from dataclasses import replace
from typing import Any, final

import gtsam
import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.gtsam import observations, solvers
from rbpf.validation.gtsam.camera_graph import FINE, CameraProblem, CameraState, adjust, covariances

LEAST = 3  #: Landmarks that fix a pose, and points that fix a frame.
LINE = 1e-3  #: Known points whose spread across a line is below this fraction of that along it lie on it.
KNOWN = 4  #: Known points that the first frame has to see.
PLACED = 5.0  #: A landmark is placed once its inverse distance differs from zero by so many standard deviations.
#: Nor is it placed nearer than this fraction of the usual distance: near cameras that rest a point fits anything.
NEAREST = 0.2
CAP = 4.5  #: What one observation of a single camera says for it at most, as a loss: one outlier must not do.
GROWTH = 1.2  #: All is adjusted whenever the number of frames has grown by this factor.
SETTLED = 30  #: A landmark seen more often moves only when all is adjusted.
LOST = 10  #: As many frames in a row without three placed landmarks are the end.
OUTLIER = 5.0  #: An observation farther off takes no part in a frame's pose, in standard deviations.
_EARLIEST = 8
_MOTION = 0.1  # of a frame: rad, and metres per metre of distance to what is seen
_FOUND = 1e-6  # fraction of the error that is no gain any more
Known = dict[int, tuple[Array, Array]]  #: Position (3,) and covariance (3, 3) by name.


def solve_features(
    log: FeatureLog,
    initial: InitialEstimate | None = None,
    *,
    robust: float | None = None,
    marginals: bool = True,
    on_iteration: solvers.OnIteration | None = None,
    tolerance: float = FINE,
) -> solvers.BatchSolution:
    """Solve for all poses and landmarks at once.

    The points known beforehand that are seen hold the world's frame. Without any, the first pose is held where it
    starts, and for a single camera, whose pixels do not tell the scale, its distance from the camera that starts
    farthest from it; the covariances then are relative to these.

    Landmarks that the `initial` estimate lacks are triangulated. By default it is found frame by frame, from four known
    points in the first frame, or for a stereo pair without any, from the identity. `robust` and `marginals` are as of
    `rbpf.validation.gtsam.robot.solve`. `on_iteration` is given the error before each iteration, also of adjustments on
    the way to an initial estimate; what it raises ends it all. `tolerance` is the fraction of the error that is no gain
    any more.

    Raises InputError: a number makes no sense, the first frame sees too few known points and there is no initial
    estimate, the estimate puts a landmark behind its camera, a frame sees too few landmarks or none that connect it,
    the known points are fewer than three or on a line, or the optimiser does not converge.
    """
    full = observations.observation_table(log)
    known = observations.known_by_name(log.known, full.names)
    problem = CameraProblem(log.name, len(log.frames), full.determined(known), known, robust)
    # Enough observations of each frame, frames that hang together, known points that fix the world's frame.
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
    start = begin(problem, initial or _Growth(problem, on_iteration).grown())
    found = adjust(problem, start, tolerance, on_iteration)
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
        iterations=found.iterations,
        undetermined=sorted({*full.names.tolist()} - {*names[~found.loose].tolist()}),
    )


def begin(problem: CameraProblem, start: InitialEstimate) -> CameraState:
    """A state near an estimate: its landmarks, known points, and the others triangulated from its poses.

    Landmarks that come out behind a camera are placed on their first rays; an InputError names one that has no place
    there.
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


def locate(table: observations.ObservationTable, known: Known) -> tuple[Array, Array]:
    """Pose of a frame of which nothing is known, from four points or more: COLMAP's P3P and consensus, then `resect`."""
    import pycolmap

    # In an image without distortion: the pixels at which a plain camera would have seen the same rays.
    camera = table.camera.camera if isinstance(table.camera, RectifiedStereo) else table.camera
    rays, points = table.bearings(), np.array([known[name][0] for name in table.names.tolist()])
    plain = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[camera.fx, 0.0, 0.0])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed = 0
    px = camera.fx * rays[:, :2] / rays[:, 2:]
    found = pycolmap.estimate_absolute_pose(px, points[table.index], plain, options)
    if found is None:
        raise InputError("no pose of the first camera explains its known points; give an initial estimate.")
    cam_from_world = found["cam_from_world"]
    pose = np.concatenate([cam_from_world.rotation.quat, cam_from_world.translation])
    return resect(table, known, SE3.inverse(SE3.normalise(pose)), 1e-9 * np.eye(6))


def resect(table: observations.ObservationTable, known: Known, near: Array, info: Array) -> tuple[Array, Array]:
    """Pose (7,) with Huber's loss, once more without the outliers, whose pull Huber only limits; covariance (6, 6).

    From observations of one frame and where its landmarks are. A weak prior stands in for what the image leaves open:
    it has its mean at `near` (7,) world_from_camera, where it starts, and the information (6, 6).
    """

    def solve(part: observations.ObservationTable, start: Array) -> tuple[Any, Any, CameraProblem]:
        problem = CameraProblem("", 1, part, known, observations.HUBER)
        points = np.array([known[name][0] for name in part.names.tolist()])
        state = CameraState(start[None], points)
        graph = problem.graph(state, np.zeros(len(points), dtype=bool), state.path)
        weak = solvers.noise(np.asarray(np.linalg.inv(info)))
        graph.push_back(gtsam.PriorFactorPose3(problem.pose_keys[0], solvers.SPATIAL.pose(near), weak))
        values, _, _ = solvers.levenberg_marquardt(graph, problem.values(state), _FOUND)
        return graph, values, problem

    graph, values, problem = solve(table, near)
    pose = problem.state(values).path
    points = np.array([known[name][0] for name in table.names.tolist()])
    inlier = observations.sigmas(table, pose, points) < OUTLIER
    if not inlier.all() and inlier.sum() >= KNOWN:
        graph, values, problem = solve(table.rows(inlier), pose[0])
    return problem.state(values).path[0], solvers.marginals(graph, values, problem.pose_keys)[0]


@final
class _Growth:
    """A path that grows frame by frame, and the landmarks placed so far.

    It begins at the known points, or for a stereo pair without any, at the first frame.
    """

    def __init__(self, problem: CameraProblem, on_iteration: solvers.OnIteration | None) -> None:
        self.problem, self.on_iteration = problem, on_iteration
        self.table, frames = problem.table, problem.frames
        self.path = np.tile(SE3.identity(), (frames, 1))
        self.blur = np.zeros(frames)
        self.points = np.zeros((len(self.table.names), 3))
        self.cov = np.zeros((len(self.table.names), 3, 3))
        self.placed, self.fixed = ~problem.free, ~problem.free
        for index in np.flatnonzero(self.placed).tolist():
            self.points[index], self.cov[index] = problem.known[int(self.table.names[index])]
        self.observations = np.zeros(len(self.points), dtype=int)
        self.usual = 0.0
        self.adjusted = _EARLIEST
        self.blind = 0

    def grown(self) -> InitialEstimate:
        """The whole path, and all landmarks that were ever placed. An InputError says where it cannot begin, or breaks."""
        for step in range(self.problem.frames):
            self._add(step)
        names, placed = self.table.names.tolist(), np.flatnonzero(self.placed).tolist()
        return InitialEstimate(self.path, {names[index]: self.points[index] for index in placed})

    def _add(self, step: int) -> None:
        """Pose of the next frame, and the landmarks it adds."""
        name, first, last = self.problem.name, *np.searchsorted(self.table.steps, [step, step + 1])
        rows = np.arange(first, last)
        now = self.table.index[rows]
        seen = rows[self.placed[now]]
        is_pair = isinstance(self.table.camera, RectifiedStereo)
        if not step and len(seen) < KNOWN and (self.problem.known or not is_pair):
            raise InputError(
                f"Frame 0 of {name} sees {len(seen)} known points, expected {KNOWN} or more, or an initial estimate."
            )
        self.blind = 0 if len(seen) >= 3 or not step else self.blind + 1
        if self.blind == LOST:
            raise InputError(
                f"Frames {step - LOST + 1} to {step} of {name} see too few known landmarks; give an initial estimate."
            )
        # The pose, from the landmarks placed so far.
        self.path[step] = self.path[max(step - 1, 0)]
        if len(seen):
            part = self.table.rows(seen)
            part = replace(part, steps=np.zeros_like(part.steps))
            at = np.searchsorted(self.table.names, part.names)
            known = dict(zip(part.names.tolist(), zip(self.points[at], self.cov[at], strict=True), strict=True))
            if step:
                far = _MOTION * self._distance(at, step)
                info = np.diag(np.repeat([_MOTION, far], 3) ** -2.0)
                self.path[step], cov = resect(part, known, self.path[step], info)
            else:
                self.path[step], cov = locate(part, known)
            # An error of the camera's place is one of the rays: as pixels at the distance of what it sees.
            focal = float(np.linalg.norm(self.table.camera.jacobian(np.array([0.0, 0.0, 1.0]))[0]))
            self.usual = self._distance(at, step)
            self.blur[step] = (focal * np.sqrt(np.trace(cov[3:, 3:]) / 3) / self.usual) ** 2
        # The landmarks of this frame from all frames so far, unless they are long settled.
        self.observations[now] += 1
        settled = self.fixed | (self.placed & (self.observations > SETTLED))
        moving = np.isin(self.table.index[:last], now[~settled[now]])
        if moving.any():
            part = self._blurred(self.table.rows(np.flatnonzero(moving)))
            points = observations.triangulate(part, self.path)
            good = self._good(part, self.path, points)
            index = np.searchsorted(self.table.names, part.names[good])
            self.points[index], self.placed[index] = points[good], True
            self.cov[index] = observations.spread(part, self.path, points)[good]
        if step + 1 >= GROWTH * self.adjusted:
            self.adjusted = step + 1
            self._adjust(step)

    def _adjust(self, step: int) -> None:
        last = np.searchsorted(self.table.steps, step + 1)
        part = self.table.rows(np.flatnonzero(self.placed[self.table.index[:last]]))
        before = np.searchsorted(self.table.names, part.names)
        problem = CameraProblem(self.problem.name, step + 1, part, self.problem.known, observations.HUBER)
        start = CameraState(self.path[: step + 1], self.points[before])
        found = adjust(problem, start, solvers.ROUGH, self.on_iteration)
        state, part = found.state, found.problem.table
        index = np.searchsorted(self.table.names, part.names)
        self.placed[before] = False
        self.path[: step + 1], self.points[index] = state.path, state.points
        part = self._blurred(part)
        good = self._good(part, state.path, state.points)
        self.placed[index] = self.fixed[index] | good
        free = ~self.fixed[index]
        self.cov[index[free]] = observations.spread(part, state.path, state.points)[free]

    def _distance(self, index: NDArray[np.intp], step: int) -> float:
        """Median distance of landmarks from a frame's camera."""
        return float(np.median(np.linalg.norm(self.points[index] - SE3.translation(self.path[step]), axis=1)))

    def _good(self, part: observations.ObservationTable, path: Array, points: Array) -> NDArray[np.bool_]:
        cap = np.inf if isinstance(part.camera, RectifiedStereo) else CAP
        distance = np.linalg.norm(points - observations.first_centres(part, path), axis=1)
        far = distance > NEAREST * self.usual
        return (
            far & observations.in_front(part, path, points) & (observations.parallax(part, path, points, cap) > PLACED)
        )

    def _blurred(self, part: observations.ObservationTable) -> observations.ObservationTable:
        blur = self.blur[part.steps][:, None, None] * np.eye(part.z.shape[1])
        return replace(part, cov_z=part.cov_z + blur)
