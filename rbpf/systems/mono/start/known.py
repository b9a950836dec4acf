"""Initialisation from known points: the first camera pose, and the points' observations in its image."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rbpf import gaussian
from rbpf.core.diagnostics import chi_square_quantile
from rbpf.core.filter import Filter
from rbpf.core.models import Records
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import LEAST, Constellation
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint
from rbpf.sensors.camera.resection import resect
from rbpf.sensors.feature_log import FeatureFrame, KnownPoints
from rbpf.sensors.features.corners import corner_score
from rbpf.sensors.readers import KnownPixels
from rbpf.systems.map_estimate import Anchored

#: Largest residual of a known point after resection: this many σ, plus this many pixels.
MAX_SIGMAS, MAX_PX = 6.0, 4.0
#: Fraction of a known point's standard deviation along an axis perpendicular to the ray: for isotropic errors, and for a
#: point triangulated from views five degrees apart.
ISOTROPIC, TRIANGULATED = 3.0**-0.5, 0.05
NOISE_PROBABILITY = 0.95  #: Quantile of residuals by noise alone, beyond which they indicate errors of the points.
SAME_PX = 1.0  #: Known points closer to each other in the image are duplicates.
FAR_AWAY = 1e6  #: Distance of the known points from the origin, in their extents, beyond which rounding is too large.
#: Least corner score of a known point, grey levels per pixel: that of noise.
MIN_TEXTURE = 2.0


def resect_known(camera: Pinhole, known: KnownPixels, noise_px: float) -> np.ndarray:
    """Pose world_from_camera (7,) that best explains the known points in the first image, equally weighted.

    Raises InputError: a point lies outside the image, two coincide, all are very far from the origin, the points do not
    determine the pose, or no pose fits them.
    """
    inside = camera.inside(known.px)
    if not inside.all():
        worst = int(np.argmin(inside))
        u, v = known.px[worst]
        raise InputError(
            f"known point {known.names[worst]} at ({u:.1f}, {v:.1f}) px lies outside the first image of "
            f"{camera.width}x{camera.height} px: give points that are seen in it"
        )
    for what, places, least in (("pixel", known.px, SAME_PX), ("position", known.positions, 0.0)):
        first, second = np.triu_indices(known.names.size, 1)
        near = np.flatnonzero(np.linalg.norm(places[first] - places[second], axis=1) <= least)
        if near.size:
            one, other = known.names[first[near[0]]], known.names[second[near[0]]]
            raise InputError(f"known points {one} and {other} have the same {what}: keep one of the two")
    away, extent = np.abs(known.positions).max(), np.ptp(known.positions, axis=0).max()
    if away > FAR_AWAY * extent:
        raise InputError(
            f"the known points lie {away:.3g} m from the origin but only {extent:.3g} m apart, too far for the filter's "
            "precision: subtract the position of one of them from all"
        )
    world_from_camera = resect(camera, known.positions, known.px)
    local = SE3.inverse_transform(world_from_camera, known.positions)
    error = np.linalg.norm(camera.project(local) - known.px, axis=1)
    allowed = MAX_SIGMAS * np.hypot(noise_px, camera.fx * known.std_m / local[:, 2]) + MAX_PX
    if (error > allowed).any():
        worst = int(np.argmax(error / allowed))
        raise InputError(
            f"no camera pose fits the known points: with the best one, known point {known.names[worst]} is "
            f"{error[worst]:.1f} px away; check the positions, their axes and which point is which"
        )
    return world_from_camera


@dataclass(frozen=True)
class KnownStart:
    """Known points, and their observations in the first frame."""

    points: KnownPoints  #: M of them.
    world_from_camera: np.ndarray  #: (7,) of the first frame, resected from them.
    rows: np.ndarray  #: (K,) rows of the observed points.
    seen: FeatureFrame  #: K features with the names of these points.

    @classmethod
    def from_pixels(cls, camera: Pinhole, known: KnownPixels, noise_px: float) -> "KnownStart":
        """From points with their pixels in the first image, named 0, 1, …; errors as `resect_known`.

        Points located by cameras or a depth sensor are uncertain along the ray, and hardly across it; the given standard
        deviation is interpreted so. The first image determines it across the ray: if the best pose leaves residuals beyond
        the measurement noise, the points are as uncertain as these, up to isotropic errors. A given standard deviation across
        the ray is a lower bound. The covariances have the traces std_m².
        """
        pose = resect_known(camera, known, noise_px)
        local = SE3.inverse_transform(pose, known.positions)
        residual = camera.project(local) - known.px
        squared, dof = float(np.square(residual).sum()), residual.size - 6
        is_noise = squared <= chi_square_quantile(NOISE_PROBABILITY, dof) * noise_px**2
        excess = 0.0 if is_noise else squared / dof - noise_px**2
        seen = excess * (local[:, 2] / camera.fx) ** 2
        least = TRIANGULATED * known.std_m if known.across_m is None else known.across_m
        most = np.maximum(ISOTROPIC * known.std_m, least)
        var_across = np.clip(seen, least**2, most**2)[:, None, None]
        line = SE3.rotation(pose) @ (local / np.linalg.norm(local, axis=1, keepdims=True))[..., None]
        along = line @ np.swapaxes(line, -1, -2)
        var_along = np.maximum(known.std_m[:, None, None] ** 2 - 2.0 * var_across, 0.0)
        cov = var_along * along + var_across * (np.eye(3) - along)
        points = KnownPoints(np.arange(known.names.size), known.positions, cov)
        noise = np.tile(noise_px**2 * np.eye(2), (known.names.size, 1, 1))
        return cls(points, pose, points.names, FeatureFrame(0, points.names, known.px, noise))

    @classmethod
    def from_frame(cls, camera: Pinhole, known: KnownPoints, first: FeatureFrame) -> "KnownStart":
        """From named features of the first frame. Raises InputError: fewer than four, or they do not determine the pose."""
        inside = np.flatnonzero(camera.inside(first.z))
        _, rows, which = np.intersect1d(known.names, first.landmarks[inside], return_indices=True)
        seen = first.take(inside[which])
        return cls(known, resect(camera, known.positions[rows], seen.z), rows, seen)


def constellation_records(
    camera: Pinhole, start: KnownStart, group: Constellation, n: int, cov_frame: np.ndarray
) -> Records:
    """Known points after the first image, whose camera is the world's origin: records (n, 1, …).

    The frame's prior is wide: an update linearised there would leave second-order errors of more than a pixel in all later
    mapping. So the joint optimum of prior and observations is found first, and the covariance is linearised there.
    `cov_frame` (6, 6) is the prior of the points' frame around the resected one.
    """
    from scipy.optimize import least_squares  # slow to import

    # Whitened residuals by x = (ξ, e_1, …, e_M): group_from_camera = T Exp(ξ), point m at k_m + e_m in the group.
    model, given, seen = CameraPoint(camera), start.points, start.seen
    chol_px = gaussian.cholesky(seen.cov_z)
    chol_prior = gaussian.cholesky(block_diag(cov_frame, *(given.cov + LEAST * np.eye(3))))

    def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return SE3.retract(start.world_from_camera, x[:6]), given.positions + x[6:].reshape(-1, 3)

    def residual(x: np.ndarray) -> np.ndarray:
        pose, local = split(x)
        nu = gaussian.solve_lower(chol_px, seen.z - model.predict(pose, local[start.rows]))
        return np.concatenate([nu.ravel(), gaussian.solve_lower(chol_prior, -x)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        pose, local = split(x)
        by_pose, by_point, _ = model.jacobians(pose, local[start.rows])
        assert by_pose is not None and by_point is not None
        rows = np.zeros((*seen.z.shape, x.size))
        rows[..., :6] = by_pose @ SE3.right_jacobian(x[:6])
        for k, m in enumerate(start.rows.tolist()):
            rows[k, :, 6 + 3 * m : 9 + 3 * m] = by_point[k]
        rows = gaussian.solve_lower_matrix(chol_px, rows).reshape(-1, x.size)
        return -np.concatenate([rows, gaussian.solve_lower_matrix(chol_prior, np.eye(x.size))])

    x = least_squares(residual, np.zeros(6 + given.positions.size), jacobian, method="lm").x
    pose, local = split(x)
    half = np.linalg.pinv(jacobian(x))
    frame = SE3.inverse(pose)
    half[:6] = -SE3.adjoint(pose) @ SE3.right_jacobian(x[:6]) @ half[:6]  # in the frame's own right chart
    moved = half[6:].reshape(*local.shape, -1) + SE3.transform_jacobian(local) @ half[:6]
    turned = (SE3.rotation(frame) @ moved).reshape(-1, half.shape[1])
    return group.started(n, SE3.transform(frame, local), gaussian.symmetrise(turned @ turned.T))


def world_of(filter_: Filter) -> Anchored | None:
    """The known points' frame in each particle's world, whose origin is its first camera; None without known points."""
    landmark_map = filter_.belief().map
    first = landmark_map.ids[:1]  # the constellation is the first landmark
    group = landmark_map.landmark_of(int(first[0])) if first.size else None
    if not isinstance(group, Constellation):
        return None
    return Anchored(*group.frame(landmark_map.read(first)))


def require_texture(image: np.ndarray, known: KnownPixels) -> None:
    """Raises InputError: the first image (H, W) uint8 has no texture at a known point."""
    score = corner_score(image, known.px)
    worst = int(np.argmin(score))
    if score[worst] < MIN_TEXTURE:
        u, v = known.px[worst]
        raise InputError(
            f"known point {known.names[worst]} at ({u:.1f}, {v:.1f}) px cannot be tracked, the first image has "
            "no corner there: check the pixel, or leave the point out"
        )
