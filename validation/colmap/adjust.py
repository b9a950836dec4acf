"""Bundle adjustment of a run's own sightings by COLMAP (Ceres): a second opinion beside GTSAM's.

COLMAP knows no priors on points and no noise but one pixel's, so the problem that both solve alike has pixels of one
standard deviation, and holds the known points exactly; these fix the gauge.
"""

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.validation.colmap.frames import from_colmap_pose, tangent_slope
from rbpf.validation.colmap.model import build_model, image_id
from rbpf.validation.gtsam.camera_data import CameraEstimate, Sightings, sightings_of
from rbpf.validation.gtsam.camera_factors import evaluate_sightings

LEAST_HELD = 3
"""Held points, not on a line, that fix the gauge."""
DAMPING = 1e-12
"""Added by COLMAP to the diagonal before it inverts; its own 1e-8 shows in the covariances."""

_SAME = 1e-9
_ITERATIONS = 200


@final
@dataclass(frozen=True, eq=False)
class ColmapAdjustment:
    """Optimum of COLMAP's bundle adjustment, in our conventions.

    Attributes:
        world_from_camera: (T, 7) poses.
        landmarks: name of each landmark to its (3,) position [m].
        cov_poses: (T, 6, 6) marginal covariances in the right chart, order [omega, v].
        cov_landmarks: name to (3, 3) marginal covariance [m^2]; zero for held points.
        error: half the sum of squared whitened residuals.
        model: the `pycolmap.Reconstruction`, adjusted.
    """

    world_from_camera: Array
    landmarks: dict[int, Array]
    cov_poses: Array
    cov_landmarks: dict[int, Array]
    error: float
    model: Any


def with_held(log: FeatureLog, held: dict[int, Array]) -> FeatureLog:
    """The log with these landmarks (name to position) known exactly, and no others: a problem for both optimisers.

    Raises:
        InputError: fewer than three, or all on a line: the gauge is not observable.
    """
    positions = np.array(list(held.values()), dtype=float).reshape(-1, 3)
    if len(positions) < LEAST_HELD or np.linalg.matrix_rank(positions[1:] - positions[0], tol=1e-6) < 2:
        raise InputError(
            f"The gauge of {log.name} is not observable: expected {LEAST_HELD} or more held landmarks that are not "
            f"on a line, found {len(positions)}; hold others."
        )
    known = KnownPoints(np.array(list(held), dtype=np.int64), positions, np.zeros((len(held), 3, 3)))
    return FeatureLog(log.name, log.camera, log.frames, known, log.truth)


def adjust_by_colmap(log: FeatureLog, initial: CameraEstimate) -> ColmapAdjustment:
    """Adjusts all poses and landmarks; the log's known points, which must be exact (`with_held`), stay where they are.

    Args:
        log: of one camera, all pixels with the same isotropic noise.
        initial: where to start; landmarks that it lacks are left out.

    Raises:
        InputError: the log is a stereo one (its shared row would count twice), its noise is of another form, the
            gauge is not observable, or COLMAP does not converge.
    """
    table, std = _checked(log, initial)
    held = dict(zip(log.known.names.tolist(), log.known.positions, strict=True)) if log.known else {}
    places = initial.landmarks | held
    points = np.array([places[name] for name in table.names.tolist()])
    model = build_model(table, initial.world_from_camera, points)
    fixed = np.isin(table.names, list(held))
    adjuster = _adjuster(model, np.flatnonzero(fixed) + 1)
    _solve(adjuster, log.name)
    path = np.array(
        [from_colmap_pose(model.image(image_id(t)).cam_from_world()) for t in range(len(log.frames))]
    )
    found = np.array([model.point3D(index + 1).xyz for index in range(len(points))])
    cov_poses, cov_points = _covariances(model, adjuster, table, path, found, fixed, std)
    residuals = evaluate_sightings(table, path, found)[0] / std
    names = table.names.tolist()
    return ColmapAdjustment(
        world_from_camera=path,
        landmarks=dict(zip(names, found, strict=True)),
        cov_poses=cov_poses,
        cov_landmarks=dict(zip(names, cov_points, strict=True)),
        error=0.5 * float(np.square(residuals).sum()),
        model=model,
    )


def _checked(log: FeatureLog, initial: CameraEstimate) -> tuple[Sightings, float]:
    if not isinstance(log.camera, Pinhole):
        raise InputError(
            f"{log.name} is a stereo log: COLMAP would count the row of each pair twice; adjust its left camera alone."
        )
    known = set() if log.known is None else set(log.known.names.tolist())
    if len(known) < LEAST_HELD or np.any(log.known.cov):  # type: ignore[union-attr]
        raise InputError(
            f"{log.name}: COLMAP has no priors on points; hold {LEAST_HELD} or more of them exactly (with_held)."
        )
    full = sightings_of(log).determined(known)
    table = full.rows(np.isin(full.names, [*initial.landmarks, *known])[full.index])
    std = float(np.sqrt(table.cov_z[0, 0, 0]))
    if np.abs(table.cov_z - std**2 * np.eye(2)).max() > _SAME * std**2:
        raise InputError(
            f"{log.name}: COLMAP takes all pixels as equally certain, found different covariances."
        )
    return table, std


def _adjuster(model: Any, held: NDArray[np.intp]) -> Any:
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.gradient_tolerance, solver.parameter_tolerance = 1e-15, 1e-13, 1e-14
    solver.max_num_iterations, solver.num_threads = _ITERATIONS, 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    for camera in model.cameras:
        config.set_constant_cam_intrinsics(camera)
    for point in held.tolist():
        config.add_constant_point(point)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def _solve(adjuster: Any, name: str) -> None:
    import pycolmap

    summary = adjuster.solve()
    if summary.termination_type != pycolmap.BundleAdjustmentTerminationType.CONVERGENCE:
        raise InputError(
            f"COLMAP's bundle adjustment of {name} did not converge; start it from a better estimate."
        )


def _covariances(
    model: Any,
    adjuster: Any,
    table: Sightings,
    path: Array,
    points: Array,
    fixed: NDArray[np.bool_],
    std: float,
) -> tuple[Array, Array]:
    """Marginals (T, 6, 6) and (L, 3, 3). COLMAP's of a point takes all poses as exact: theirs is carried over to it."""
    import pycolmap

    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.POSES_AND_POINTS
    options.damping = DAMPING
    found = pycolmap.estimate_ba_covariance(options, model, adjuster)
    if found is None:
        raise InputError(
            "COLMAP could not invert the adjustment's information: the gauge is not observable, hold more landmarks."
        )
    count = len(path)
    joint = np.zeros((count, count, 6, 6))
    for i in range(count):
        joint[i, i] = found.get_cam_cov_from_world(image_id(i))
        for j in range(i + 1, count):
            joint[i, j] = found.get_cam_cross_cov_from_world(image_id(i), image_id(j))
            joint[j, i] = joint[i, j].T
    joint = std**2 * _in_our_chart(joint, path)
    within = np.array(
        [
            np.zeros((3, 3)) if held else std**2 * found.get_point_cov(index + 1)
            for index, held in enumerate(fixed)
        ]
    )
    return joint[np.arange(count), np.arange(count)], _marginal(table, path, points, within, joint, std)


def _in_our_chart(joint: Array, path: Array) -> Array:
    """Blocks (T, T, 6, 6) of COLMAP's tangents in ours."""
    slope = tangent_slope(path)
    return slope[:, None] @ joint @ np.swapaxes(slope, -1, -2)[None]


def _marginal(table: Sightings, path: Array, points: Array, within: Array, joint: Array, std: float) -> Array:
    """P + Σ_ij G_i Σ_ij G_jᵀ of each point, where G_i = −P H_li says how it follows pose i."""
    by_pose, by_point = evaluate_sightings(table, path, points)[1]
    out = np.empty_like(within)
    for index in range(len(points)):
        rows = np.flatnonzero(table.index == index)
        steps = table.steps[rows]
        follows = -within[index] @ (by_point[rows].mT @ by_pose[rows]) / std**2
        spread = np.einsum("iab,ijbc,jdc->ad", follows, joint[steps[:, None], steps[None]], follows)
        out[index] = within[index] + spread
    return out
