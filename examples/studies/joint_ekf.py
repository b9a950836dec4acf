"""A plain EKF-SLAM on the same measurements, as an independent reference: one Gaussian of pose and map."""

from typing import NamedTuple

import numpy as np

from rbpf.lie import Array
from rbpf.sensors.readers.measurements import Measurements


class Filtered(NamedTuple):
    """Filtered means (T, E), covariances (T, d, d), the last map with its covariances, the log-evidence."""

    world_from_robot: Array
    cov_poses: Array
    landmarks: dict[int, Array]
    cov_landmarks: dict[int, Array]
    log_evidence: float


def joint_ekf(m: Measurements) -> Filtered:
    """Predict, update jointly with all known landmarks, append new ones; the pose in the right chart."""
    space, model, dim = m.space, m.model(), m.space.dim
    pose, points, cov, places = m.start, np.empty((0, m.z.shape[1])), np.zeros((dim, dim)), dict[int, int]()
    path, pose_covs, log_evidence = [], [], 0.0
    for step in range(len(m.stamps_ns)):
        if step:
            pose, cov = _predicted(space, pose, cov, m.deltas[step - 1], m.covs[step - 1])
        rows = np.flatnonzero(m.steps == step)
        known = [row for row in rows if int(m.landmarks[row]) in places]
        if known:
            at = np.array([places[int(m.landmarks[row])] for row in known])
            nu, slope = _innovation(model, m.z[known], pose, points, at, dim)
            increment, cov, log_density = _updated(nu, slope, cov, m.cov_z[known])
            pose = space.retract(pose, increment[:dim])
            points = points + increment[dim:].reshape(points.shape)
            log_evidence += log_density
        for row in rows:
            if int(m.landmarks[row]) not in places:
                places[int(m.landmarks[row])] = len(points)
                points, cov = _appended(model, pose, points, cov, m.z[row], m.cov_z[row])
        path.append(pose)
        pose_covs.append(cov[:dim, :dim].copy())  # a view would keep every step's full covariance
    blocks = {name: _block(cov, dim, len(m.z[0]), i) for name, i in places.items()}
    landmarks = {name: points[i] for name, i in places.items()}
    return Filtered(np.array(path), np.array(pose_covs), landmarks, blocks, log_evidence)


def _predicted(space, pose, cov, delta, noise):
    dim, back = space.dim, space.adjoint(space.inverse(delta))
    cov = cov.copy()
    cov[:dim] = back @ cov[:dim]
    cov[:, :dim] = cov[:, :dim] @ back.T
    cov[:dim, :dim] += noise
    return space.compose(pose, delta), cov


def _innovation(model, z, pose, points, at, dim):
    seen = points[at]
    by_state, by_landmark, _ = model.jacobians(pose, seen)
    count, p, size = by_landmark.shape
    slope = np.zeros((count, p, dim + points.size))
    slope[:, :, :dim] = by_state
    for k, i in enumerate(at):
        slope[k, :, dim + size * i : dim + size * (i + 1)] = by_landmark[k]
    return model.residual(z, model.predict(pose, seen)).ravel(), slope.reshape(count * p, -1)


def _updated(nu, slope, cov, noises):
    used = np.flatnonzero(slope.any(axis=0))  # few of many landmarks are in view
    seen = slope[:, used] @ cov[used]
    innovation = seen[:, used] @ slope[:, used].T
    p = noises.shape[-1]
    for k, noise in enumerate(noises):
        innovation[k * p : (k + 1) * p, k * p : (k + 1) * p] += noise
    gain = np.linalg.solve(innovation, seen).T
    log_det = np.linalg.slogdet(2 * np.pi * innovation)[1]
    log_density = -0.5 * (nu @ np.linalg.solve(innovation, nu) + log_det)
    cov = cov - gain @ seen
    return gain @ nu, 0.5 * (cov + cov.T), float(log_density)


def _appended(model, pose, points, cov, z, noise):
    point = model.invert(pose, z)
    by_state, by_landmark, _ = model.jacobians(pose, point)
    inverse, dim = np.linalg.inv(by_landmark), by_state.shape[1]
    cross = -inverse @ by_state @ cov[:dim]
    corner = inverse @ (by_state @ cov[:dim, :dim] @ by_state.T + noise) @ inverse.T
    return np.vstack([points, point]), np.block([[cov, cross.T], [cross, corner]])


def _block(cov, dim, size, i):
    rows = slice(dim + size * i, dim + size * (i + 1))
    return cov[rows, rows]
