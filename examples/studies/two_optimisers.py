"""Bundle adjustment of a run's observations by both GTSAM and COLMAP (Ceres), which should agree.

COLMAP supports no priors on points and only one standard deviation of all pixels, so the common problem has equal pixel
noise and exact known points; without any, the run's most often observed landmarks are held. Without `--run`, the folder
of a finished monocular run, a desk is simulated.

COLMAP's Ceres perturbs cam_from_world = (R, t) as (Exp(2 δ) R, t + v): the quaternion from the left by HALF a rotation
vector, the translation by addition, all in the camera's axes. With T = cam_from_world⁻¹ that is T Exp(ξ) with
ξ = −(2 δ, v − 2 δ × t) to first order. `pycolmap.get_covariance_for_inverse` takes a whole rotation vector and so does
not match the result of `estimate_ba_covariance`. The tests check this for the installed build.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
import tyro
from numpy.typing import NDArray

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.files import write_table
from rbpf.runs.measurement_files import read_feature_log
from rbpf.runs.plots import new_axes, save_figures
from rbpf.runs.reading import RunFolder
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.colmap.model import build_model, from_colmap_pose, image_id
from rbpf.validation.gtsam.batch_problem import connected_frames
from rbpf.validation.gtsam.camera import solve_features
from rbpf.validation.gtsam.observations import ObservationTable, observation_table, reprojection
from rbpf.validation.gtsam.solvers import BatchSolution

LEAST_HELD = 3
"""Number of held points, not collinear, that fix the gauge."""
DAMPING = 1e-12
"""Damping added by COLMAP to the diagonal before inversion; its default 1e-8 affects the covariances."""

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
    """The log with exactly these known landmarks (name to position), without errors: a problem for both optimisers.

    Raises:
        InputError: fewer than three, or all collinear: the gauge is not observable.
    """
    positions = np.array(list(held.values()), dtype=float).reshape(-1, 3)
    if len(positions) < LEAST_HELD or np.linalg.matrix_rank(positions[1:] - positions[0], tol=1e-6) < 2:
        raise InputError(
            f"The gauge of {log.name} is not observable: expected {LEAST_HELD} or more held landmarks that are not "
            f"on a line, found {len(positions)}; hold others."
        )
    known = KnownPoints(np.array(list(held), dtype=np.int64), positions, np.zeros((len(held), 3, 3)))
    return FeatureLog(log.name, log.camera, log.frames, known, log.truth)


def adjust_by_colmap(log: FeatureLog, initial: InitialEstimate) -> ColmapAdjustment:
    """Adjusts all poses and landmarks; the log's known points, which must be exact (`with_held`), are fixed.

    Args:
        log: of one camera, all pixels with the same isotropic noise.
        initial: initial estimate; landmarks missing in it are left out.

    Raises:
        InputError: the log is a stereo one (its shared row would count twice), its noise is of another form, the
            gauge is not observable, or COLMAP does not converge.
    """
    table, std = _checked(log, initial)
    held = dict(zip(log.known.names.tolist(), log.known.positions, strict=True)) if log.known else {}
    places = initial.landmarks | held
    points = np.array([places[name] for name in table.names.tolist()])
    model = build_model(table, initial.world_from_body, points)
    fixed = np.isin(table.names, list(held))
    adjuster = _adjuster(model, np.flatnonzero(fixed) + 1)
    _solve(adjuster, log.name)
    path = np.array([from_colmap_pose(model.image(image_id(t)).cam_from_world()) for t in range(len(log.frames))])
    found = np.array([model.point3D(index + 1).xyz for index in range(len(points))])
    cov_poses, cov_points = _covariances(model, adjuster, table, path, found, fixed, std)
    residuals = reprojection(table, path, found)[0] / std
    names = table.names.tolist()
    return ColmapAdjustment(
        world_from_camera=path,
        landmarks=dict(zip(names, found, strict=True)),
        cov_poses=cov_poses,
        cov_landmarks=dict(zip(names, cov_points, strict=True)),
        error=0.5 * float(np.square(residuals).sum()),
        model=model,
    )


def _checked(log: FeatureLog, initial: InitialEstimate) -> tuple[ObservationTable, float]:
    if not isinstance(log.camera, Pinhole):
        raise InputError(
            f"{log.name} is a stereo log: COLMAP would count the row of each pair twice; adjust its left camera alone."
        )
    known = set() if log.known is None else set(log.known.names.tolist())
    if len(known) < LEAST_HELD or np.any(log.known.cov):  # type: ignore[union-attr]
        raise InputError(
            f"{log.name}: COLMAP has no priors on points; hold {LEAST_HELD} or more of them exactly (with_held)."
        )
    full = observation_table(log).determined(known)
    table = full.rows(np.isin(full.names, [*initial.landmarks, *known])[full.index])
    std = float(np.sqrt(table.cov_z[0, 0, 0]))
    if np.abs(table.cov_z - std**2 * np.eye(2)).max() > _SAME * std**2:
        raise InputError(f"{log.name}: COLMAP takes all pixels as equally certain, found different covariances.")
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
        raise InputError(f"COLMAP's bundle adjustment of {name} did not converge; start it from a better estimate.")


def _covariances(
    model: Any, adjuster: Any, table: ObservationTable, path: Array, points: Array, fixed: NDArray[np.bool_], std: float
) -> tuple[Array, Array]:
    """Marginals (T, 6, 6) and (L, 3, 3). COLMAP's for a point is conditional on the poses: their covariance is propagated."""
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
        [np.zeros((3, 3)) if held else std**2 * found.get_point_cov(index + 1) for index, held in enumerate(fixed)]
    )
    return joint[np.arange(count), np.arange(count)], _marginal(table, path, points, within, joint, std)


def _in_our_chart(joint: Array, path: Array) -> Array:
    """Converts blocks (T, T, 6, 6) from COLMAP's tangents to ours."""
    slope = tangent_slope(path)
    return slope[:, None] @ joint @ np.swapaxes(slope, -1, -2)[None]


def _marginal(table: ObservationTable, path: Array, points: Array, within: Array, joint: Array, std: float) -> Array:
    """P + Σ_ij G_i Σ_ij G_jᵀ of each point, where G_i = −P H_li is its derivative with respect to pose i."""
    by_pose, by_point = reprojection(table, path, points)[1]
    out = np.empty_like(within)
    for index in range(len(points)):
        rows = np.flatnonzero(table.index == index)
        steps = table.steps[rows]
        follows = -within[index] @ (by_point[rows].mT @ by_pose[rows]) / std**2
        spread = np.einsum("iab,ijbc,jdc->ad", follows, joint[steps[:, None], steps[None]], follows)
        out[index] = within[index] + spread
    return out


HELD = 4
"""Number of held landmarks without known points."""


@final
@dataclass(frozen=True, eq=False)
class TwoOptima:
    """Both optima of one problem.

    Attributes:
        log: the problem, with held landmarks as exact known points.
        gtsam: one optimum.
        colmap: the other.
        pose_differences: (T, 6) of the poses in the right chart [rad, m].
        landmark_differences_m: (L,) distances of the free landmarks.
        pose_covariance_errors: (T,) Frobenius norms of the covariances' differences over those of GTSAM's.
        landmark_covariance_errors: (L,) likewise.
    """

    log: FeatureLog
    gtsam: BatchSolution
    colmap: ColmapAdjustment
    pose_differences: Array
    landmark_differences_m: Array
    pose_covariance_errors: Array
    landmark_covariance_errors: Array

    def as_dict(self) -> dict[str, Any]:
        """The largest of each, for JSON."""
        return {
            "frames": len(self.pose_differences),
            "landmarks": len(self.landmark_differences_m),
            "held": 0 if self.log.known is None else len(self.log.known.names),
            "error_gtsam": self.gtsam.error,
            "error_colmap": self.colmap.error,
            "pose_difference_max": float(np.abs(self.pose_differences).max()),
            "landmark_difference_max_m": float(self.landmark_differences_m.max(initial=0.0)),
            "pose_covariance_error_max": float(self.pose_covariance_errors.max()),
            "landmark_covariance_error_max": float(self.landmark_covariance_errors.max(initial=0.0)),
        }


def adjust_by_both(log: FeatureLog, world_from_camera: Array) -> TwoOptima:
    """Adjusts a log by both optimisers, from the same initial poses.

    Landmarks that the observations do not determine are left out of both.

    Args:
        log: of one camera, all pixels with the same isotropic noise.
        world_from_camera: (T, 7) initial path of both, such as a run's.

    Raises:
        InputError: too few observations to fix the gauge, or an optimiser does not converge.
    """
    frames = connected_frames(log)
    if frames.size < 2:
        raise InputError(f"{log.name}: no two frames share enough landmarks for a batch adjustment.")
    log = replace(log, frames=[log.frames[t] for t in frames.tolist()])
    start = world_from_camera[frames]
    free = solve_features(log, InitialEstimate(start, {}), marginals=False)
    settled = {name: free.landmarks[name] for name in sorted(free.landmarks.keys() - set(free.undetermined))}
    held = _held(log, settled)
    problem = with_held(_only(log, settled), held)
    gtsam = solve_features(problem, InitialEstimate(free.world_from_body, settled | held))
    colmap = adjust_by_colmap(problem, InitialEstimate(start, settled | held))
    names = sorted(colmap.landmarks.keys() - held.keys())
    return TwoOptima(
        log=problem,
        gtsam=gtsam,
        colmap=colmap,
        pose_differences=SE3.local(gtsam.world_from_body, colmap.world_from_camera),
        landmark_differences_m=np.array(
            [np.linalg.norm(gtsam.landmarks[name] - colmap.landmarks[name]) for name in names]
        ),
        pose_covariance_errors=_errors(colmap.cov_poses, gtsam.cov_poses),
        landmark_covariance_errors=_errors(
            *(np.array([one.cov_landmarks[name] for name in names]) for one in (colmap, gtsam))
        ),
    )


def _held(log: FeatureLog, settled: dict[int, Array]) -> dict[int, Array]:
    """Known points at their given positions; else, of the most often observed landmarks, those farthest apart."""
    if log.known is not None:
        given = dict(zip(log.known.names.tolist(), log.known.positions, strict=True))
        return {name: point for name, point in given.items() if name in settled}
    names, counts = np.unique(np.concatenate([frame.landmarks for frame in log.frames]), return_counts=True)
    often = [name for name in names[np.argsort(-counts, kind="stable")].tolist() if name in settled]
    candidates = often[: max(len(often) // 2, LEAST_HELD)]
    chosen = candidates[:1]
    while len(chosen) < min(HELD, len(candidates)):
        gaps = [min(np.linalg.norm(settled[name] - settled[other]) for other in chosen) for name in candidates]
        chosen.append(candidates[int(np.argmax(gaps))])
    return {name: settled[name] for name in chosen}


def _only(log: FeatureLog, settled: dict[int, Array]) -> FeatureLog:
    names, frames = np.array(list(settled), dtype=np.int64), []
    for frame in log.frames:
        kept = np.isin(frame.landmarks, names)
        frames.append(FeatureFrame(frame.stamp_ns, frame.landmarks[kept], frame.z[kept], frame.cov_z[kept]))
    return replace(log, frames=frames)


def _errors(found: Array, expected: Array) -> Array:
    def norm(cov: Array) -> Array:
        return np.sqrt(np.square(cov).sum((-1, -2)))

    return norm(found - expected) / norm(expected)


def tangent_slope(world_from_camera: Array) -> Array:
    """Matrices (..., 6, 6) from COLMAP's tangent at the inverse of poses (..., 7) to ours; see the head of this file."""
    shift = SE3.translation(SE3.inverse(world_from_camera))
    slope = np.zeros((*shift.shape[:-1], 6, 6))
    slope[..., :3, :3] = -2.0 * np.eye(3)
    slope[..., 3:, :3] = -2.0 * _cross(shift)
    slope[..., 3:, 3:] = -np.eye(3)
    return slope


def _cross(v: Array) -> Array:
    """Matrices (..., 3, 3) with [v] w = v x w."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape, 3)


def main(run: Path | None = None, out: Path = Path("demo/two_optimisers"), quick: bool = False) -> dict[str, float]:
    """Adjusts a run's observations twice and prints the largest differences.

    Args:
        run: folder of a finished monocular run.
        out: folder for the table.
        quick: a shorter simulation.
    """
    if run is None:
        world = DeskWorld(frames=30 if quick else 150)
        log = simulate_features(world, Measuring(known=6, known_std_m=0.0), MONO, seed=0)
        assert log.truth is not None
        path = log.truth.poses
    else:
        log, path = read_feature_log(run), RunFolder.open(run).path.world_from_body
    found = adjust_by_both(log, path)
    entries = {name: float(value) for name, value in found.as_dict().items()}
    write_table(out / "two_optimisers.csv", ("figure", "value"), list(entries.items()))
    figure, axes = new_axes("GTSAM and COLMAP", "frame", "difference of the pose")
    axes.semilogy(np.abs(found.pose_differences), label=["ωx", "ωy", "ωz", "x [m]", "y", "z"])
    axes.legend(fontsize="small")
    save_figures({"two_optimisers.png": figure}, out)
    return entries


if __name__ == "__main__":
    tyro.cli(main)
