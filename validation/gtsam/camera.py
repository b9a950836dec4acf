"""Batch adjustment of camera features by GTSAM: all poses and landmarks that explain the pixels best.

The same measurements and the same noise as a filter had, without its samples and without its order in time.
B. Triggs et al., "Bundle adjustment: a modern synthesis" (2000);
F. Dellaert and M. Kaess, "Factor graphs for robot perception" (2017).
"""

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.gtsam import observations, solvers
from rbpf.validation.gtsam.camera_graph import FINE, CameraProblem, CameraState, adjust, covariances

LEAST = 3  #: Landmarks that fix a pose, and points that fix a frame.
LINE = 1e-3  #: Known points whose spread across a line is below this fraction of that along it lie on it.
POINTS = 4  #: That a frame has to see to be located.
#: Frames after which a path that is found frame by frame is first adjusted, and its growth until the next time, a factor.
FIRST, LONGER = 8, 1.2


def solve_features(
    log: FeatureLog,
    initial: InitialEstimate,
    *,
    from_known: bool = False,
    robust: float | None = None,
    marginals: bool = True,
    on_iteration: solvers.OnIteration | None = None,
    tolerance: float = FINE,
) -> solvers.BatchSolution:
    """Solve for all poses and landmarks at once.

    The points known beforehand that are seen hold the world's frame. Without any, the first pose is held where it
    starts, and for a single camera, whose pixels do not tell the scale, its distance from the camera that starts
    farthest from it; the covariances then are relative to these.

    Landmarks that the `initial` estimate lacks are triangulated. With `from_known` it begins at the known points, and takes
    of the estimate only motions of frames that see too little, see `grown`. `robust` and `marginals` are as of
    `rbpf.validation.gtsam.robot.solve`. `on_iteration` is given the error before each iteration, also of adjustments on
    the way to where it begins; what it raises ends it all. `tolerance` is the fraction of the error that is no gain any
    more.

    Raises InputError: a number makes no sense, the estimate puts a landmark behind its camera, a frame sees too few
    landmarks or none that connect it, the known points are fewer than three or on a line, or the optimiser does not
    converge.
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


def grown(
    problem: CameraProblem, start: InitialEstimate, on_iteration: solvers.OnIteration | None = None
) -> InitialEstimate:
    """A path that begins at the known points, and is found again frame by frame from the landmarks that have a place so far.

    A frame that sees too few of them goes on by the motion of the path that is given; nothing else of it is taken. Whenever
    it has become longer by a fraction, landmarks are triangulated and all is adjusted, because errors would grow else.
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
        # Landmarks that are seen from places far enough apart, and all frames so far adjusted to them.
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
    # In an image without distortion: the pixels at which a plain camera would have seen the same rays.
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
