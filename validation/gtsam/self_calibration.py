"""A camera calibrated by what a run measured: the focal length and k1 that its batch adjustment prefers."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import prepare_folder, write_text
from rbpf.runs.reading import RunFolder
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.images.calibration import NAME
from rbpf.validation.calibration import camera_text
from rbpf.validation.gtsam.batch_problem import read_problem
from rbpf.validation.gtsam.mono_batch import Batch, adjust_log

_AROUND = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1)], dtype=float)
"""Where the error is looked at, beside the middle, for a quadratic of two variables."""

_STEPS = np.array([[0.01, 0.02], [0.003, 0.006]])
"""Of focal length, as a fraction, and of k1: first a coarse grid, then a fine one."""

ROUNDS = 4
"""A grid follows the lowest error so often at most."""

Told = Callable[[int, int], None]
"""Told the rounds done, and the most that there can be."""


@dataclass(frozen=True)
class Calibrated:
    """A camera whose focal length and k1 explain the measurements best.

    Attributes:
        camera: the same but for them.
        batch: the optimum with it.
        std: (2,) standard deviations of the focal length, as a fraction, and of k1, with all poses and landmarks unknown;
            NaN where the error has no lowest point nearby.
    """

    camera: Pinhole
    batch: Batch
    std: np.ndarray


def refine_calibration(log: FeatureLog, batch: Batch, told: Told | None = None) -> Calibrated:
    """Focal length and k1 of the least error of the batch: the lowest point of quadratics, fitted again and again.

    The error is half the squared misfit with the best poses and landmarks for each camera, so that the quadratic's
    curvature is the information about the two alone.

    Args:
        log: the measurements, of one camera.
        batch: their optimum with the given camera.
        told: called after each round.

    Raises:
        InputError: a batch adjustment fails.
    """
    best, std, done = batch, np.full(2, np.nan), 0
    for size in _STEPS:
        for _ in range(ROUNDS):
            camera = _camera(best.log)
            solved = [best, *(_with_camera(log, best, _changed(camera, *(size * step))) for step in _AROUND)]
            lowest, inverse = _lowest(np.array([one.solution.error for one in solved]))
            solved.append(_with_camera(log, best, _changed(camera, *(size * lowest))))
            best = min(solved, key=lambda one: one.solution.error)
            std = size * np.sqrt(np.diagonal(inverse))
            done += 1
            if told is not None:
                told(done, ROUNDS * len(_STEPS))
            if np.abs(lowest).max() <= 1.0:
                break
    return Calibrated(_camera(best.log), best, std)


def adjust_near(log: FeatureLog, batch: Batch) -> Batch:
    """The optimum of a log that is nearly the batch's, from the batch's."""
    path = np.tile(SE3.identity(), (len(log.frames), 1))
    path[batch.frames] = batch.world_from_camera
    return adjust_log(log, path, twice=False)


def recalibrate(folder: Path, out: Path, told: Told | None = None) -> tuple[dict[str, Any], Calibrated]:
    """Calibrates the camera of a finished monocular run, and writes camera.yaml.

    Args:
        folder: of the run.
        out: folder for camera.yaml.
        told: called after each round.

    Returns:
        What changed, for the user, and the camera.

    Raises:
        InputError: the folder holds no run of one camera, or what it measured cannot be adjusted.
    """
    problem = read_problem(folder)
    if not isinstance(problem, FeatureLog) or not isinstance(problem.camera, Pinhole):
        raise InputError(f"{folder} is no run of one camera: only that can calibrate its camera")
    start = adjust_log(problem, RunFolder.open(folder).estimate.world_from_body)
    found = refine_calibration(problem, start, told)
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
    entries["error_before"], entries["error_after"] = start.solution.error, found.batch.solution.error
    return entries, found


def _camera(log: FeatureLog) -> Pinhole:
    assert isinstance(log.camera, Pinhole)
    return log.camera


def _changed(camera: Pinhole, focal: float, k1: float) -> Pinhole:
    k1_now, *others = camera.distortion
    return replace(
        camera,
        fx=camera.fx * (1.0 + focal),
        fy=camera.fy * (1.0 + focal),
        distortion=(k1_now + k1, *others),
    )


def _with_camera(log: FeatureLog, batch: Batch, camera: Pinhole) -> Batch:
    return adjust_near(replace(log, camera=camera), batch)


def _lowest(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the quadratic through errors (7,), in the middle and around it, is lowest, no farther out than two steps.

    Returns:
        The place (2,) and the inverse (2, 2) of the curvature, NaN where the quadratic has no lowest point.
    """
    grid = np.concatenate([np.zeros((1, 2)), _AROUND])
    a, b = grid.T
    terms = np.stack([np.ones_like(a), a, b, 0.5 * a * a, a * b, 0.5 * b * b], axis=1)
    _, ga, gb, haa, hab, hbb = np.linalg.lstsq(terms, errors, rcond=None)[0]
    hessian = np.array([[haa, hab], [hab, hbb]])
    if np.linalg.eigvalsh(hessian)[0] <= 0.0:
        return np.asarray(2.0 * grid[np.argmin(errors)]), np.full((2, 2), np.nan)
    return np.clip(-np.linalg.solve(hessian, [ga, gb]), -2.0, 2.0), np.linalg.inv(hessian)
