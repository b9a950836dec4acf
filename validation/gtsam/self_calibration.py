"""Self-calibration of a camera from a run's measurements: focal length and k1 of its batch adjustment."""

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import OnDone, prepare_folder, write_text
from rbpf.runs.reading import RunFolder
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.images.calibration import NAME, camera_text
from rbpf.validation.gtsam.batch_problem import Optimum, softened, solve_problem
from rbpf.validation.gtsam.camera import FINE, SCALE, CameraProblem, CameraState, adjust, begin
from rbpf.validation.gtsam.observations import HUBER, Residuals, known_by_name, observation_table, reprojection
from rbpf.validation.gtsam.solvers import levenberg_marquardt, marginals, together

ITERATIONS = 200  #: Maximum iterations of the adjustment.
_STEP = 1e-6  #: Step of focal length and k1 for numeric derivatives of the residuals.


@dataclass(frozen=True)
class Calibrated:
    """A camera with the optimal focal length and k1, and the optimum with it.

    `std` (2,) are standard deviations of the focal length, as a fraction, and of k1, marginal over poses and landmarks; NaN
    if the measurements do not determine them.
    """

    camera: Pinhole
    batch: Optimum
    std: np.ndarray


def refine_calibration(log: FeatureLog, batch: Optimum, on_round: OnDone | None = None) -> Calibrated:
    """Focal length and k1 adjusted together with all poses and landmarks, from the optimum with the given camera.

    `on_round` is called with the number of iterations done and the maximum. Errors as of `solve_problem`.
    """
    assert isinstance(batch.problem, FeatureLog) and isinstance(batch.problem.camera, Pinhole)
    camera, key = batch.problem.camera, int(gtsam.symbol("c", 0))
    found = adjust(*camera_problem(batch.problem, batch))
    problem, path = found.problem, batch.estimate.world_from_body
    graph = problem.graph(found.state, found.loose, path, SCALE, with_camera(problem, camera, key))
    values = problem.values(found.state)
    values.insert(key, np.zeros(2))
    done = count(1)
    tell, std = on_round or (lambda _done, _most: None), np.full(2, np.nan)
    try:
        values, _, _ = levenberg_marquardt(graph, values, FINE, ITERATIONS, lambda _error: tell(next(done), ITERATIONS))
        std = np.sqrt(np.diagonal(marginals(graph, values, [key])[0]))
    except RuntimeError:
        pass
    better = adjust_near(replace(log, camera=changed(camera, values.atVector(key))), batch)
    best = min(batch, better, key=lambda one: one.error)
    assert isinstance(best.problem, FeatureLog) and isinstance(best.problem.camera, Pinhole)
    return Calibrated(best.problem.camera, best, std)


def camera_problem(log: FeatureLog, batch: Optimum) -> tuple[CameraProblem, CameraState]:
    """The problem of a log equal or close to the batch's, and its optimum."""
    full = observation_table(log)
    known = known_by_name(softened(log.known), full.names)
    problem = CameraProblem(log.name, len(batch.steps), full.determined(known), known, HUBER)
    return problem, begin(problem, batch.start)


def with_camera(problem: CameraProblem, camera: Pinhole, key: int) -> list[Any]:
    """Factors of the observations that also depend on the variable of a key: a change (2,) of the camera, see `changed`."""

    def evaluate(values: Any) -> Residuals:
        state, change = problem.state(values), values.atVector(key)

        def at(change: np.ndarray) -> Residuals:
            return reprojection(replace(problem.table, camera=changed(camera, change)), state.path, state.points)

        residuals, slopes = at(change)
        moved = [at(change + step)[0] - at(change - step)[0] for step in _STEP * np.eye(2)]
        return residuals, [*slopes, np.stack(moved, axis=-1) / (2.0 * _STEP)]

    factor = together(evaluate)
    return problem.factors_by_row(lambda row, model, pose, point: factor(row, [pose, point, key], model))


def changed(camera: Pinhole, change: np.ndarray) -> Pinhole:
    """A camera whose focal lengths are longer by a fraction, and whose k1 is larger."""
    k1, *others = camera.distortion
    focal = 1.0 + float(change[0])
    lens = (k1 + float(change[1]), *others)
    return replace(camera, fx=camera.fx * focal, fy=camera.fy * focal, distortion=lens)


def adjust_near(log: FeatureLog, batch: Optimum) -> Optimum:
    """The optimum of a log close to the batch's, initialised by the batch's."""
    path = np.tile(SE3.identity(), (len(log.frames), 1))
    path[batch.steps] = batch.estimate.world_from_body
    return solve_problem(log, path, HUBER, marginals=False, twice=False)


def recalibrate(folder: Path, out: Path, on_round: OnDone | None = None) -> tuple[dict[str, Any], Calibrated]:
    """Calibrates the camera of a finished monocular run; writes camera.yaml; returns the changes and the camera."""
    record = RunFolder.open(folder)
    problem = record.measurements
    if not isinstance(problem, FeatureLog) or not isinstance(problem.camera, Pinhole):
        raise InputError(f"{folder} is no run of one camera: only that can calibrate its camera")
    start = solve_problem(problem, record.estimate.world_from_body, HUBER, marginals=False)
    found = refine_calibration(problem, start, on_round)
    prepare_folder(out)
    about = f"focal length and k1 from what the run over {problem.name} measured"
    write_text(out / NAME, camera_text(found.camera, about))
    before, after = problem.camera, found.camera
    entries: dict[str, Any] = {
        "fx": {"before": before.fx, "after": after.fx},
        "fy": {"before": before.fy, "after": after.fy},
        "k1": {"before": before.distortion[0], "after": after.distortion[0]},
    }
    fractions = {"std_focal_share": found.std[0], "std_k1": found.std[1]}
    entries |= {name: float(value) if np.isfinite(value) else None for name, value in fractions.items()}
    entries["error_before"], entries["error_after"] = start.error, found.batch.error
    return entries, found
