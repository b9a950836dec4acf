"""Covariances as logs write them: upper triangles, in additive coordinates, rounded to a few digits."""

import numpy as np

from rbpf.lie import SE2, SE3, Array
from rbpf.sensors.readers.table import Table

_ROUNDING = 1e-5


def read_covariances(table: Table, first: str, last: str) -> Array:
    """Symmetric matrices from the columns of their upper triangle, row by row.

    A matrix that is positive semi-definite up to the rounding of its printed digits passes.

    Args:
        table: n rows.
        first: column of the first entry.
        last: column of the last entry.

    Returns:
        (n, d, d).

    Raises:
        InputError: a matrix is not positive semi-definite.
    """
    triangle = table.block(first, last)
    dim = int(np.sqrt(2 * triangle.shape[1]))
    row, column = np.triu_indices(dim)
    cov = np.empty((len(triangle), dim, dim))
    cov[:, row, column] = cov[:, column, row] = triangle
    invalid = ~_semi_definite(cov)
    if invalid.any():
        problem = f"expected {first} to {last} to be a covariance, found an indefinite matrix"
        raise table.error(int(np.argmax(invalid)), problem)
    return cov


def _semi_definite(cov: Array) -> np.ndarray:
    # Judged on the correlations, because metres and radians differ by orders of magnitude.
    variance = np.einsum("nii->ni", cov)
    std = np.sqrt(np.maximum(variance, 0.0))
    bound = std[:, :, None] * std[:, None, :] * (1.0 + _ROUNDING)
    valid = (variance >= 0).all(1) & (np.abs(cov) <= bound).all((1, 2))
    scale = np.where(std > 0, std, 1.0)[valid]
    correlation = cov[valid] / scale[:, :, None] / scale[:, None, :]
    valid[valid] = np.linalg.eigvalsh(correlation)[:, 0] >= -_ROUNDING
    return valid


def planar_to_chart(delta: Array, cov: Array) -> Array:
    """Covariance of additive errors of (x, y, heading) in the right chart at delta.

    delta Exp(xi) has the translation t + R v and the heading phi + omega to first order, so omega = d phi and
    v = R^T d t.

    Args:
        delta: (n, 3) elements of SE(2).
        cov: (n, 3, 3) covariance in the order x, y, heading.

    Returns:
        (n, 3, 3) covariance in the order omega, v.
    """
    jacobian = np.zeros((len(delta), 3, 3))
    jacobian[:, 0, 2] = 1.0
    jacobian[:, 1:, :2] = SE2.rotation(delta).mT
    return _propagated(jacobian, cov)


def spatial_to_chart(delta: Array, ypr: Array, cov: Array) -> Array:
    """Covariance of additive errors of (x, y, z, yaw, pitch, roll) in the right chart at delta.

    For R = Rz(yaw) Ry(pitch) Rx(roll) the body's angular rate is
    omega = Rx^T (Ry^T e_z d yaw + e_y d pitch) + e_x d roll; the translation part is v = R^T d t.

    Args:
        delta: (n, 7) elements of SE(3).
        ypr: (n, 3) their yaw, pitch and roll [rad].
        cov: (n, 6, 6) covariance in the order x, y, z, yaw, pitch, roll.

    Returns:
        (n, 6, 6) covariance in the order omega, v.
    """
    _, pitch, roll = ypr.T
    jacobian = np.zeros((len(delta), 6, 6))
    jacobian[:, 0, 3] = -np.sin(pitch)
    jacobian[:, 1, 3] = np.sin(roll) * np.cos(pitch)
    jacobian[:, 2, 3] = np.cos(roll) * np.cos(pitch)
    jacobian[:, 1, 4] = np.cos(roll)
    jacobian[:, 2, 4] = -np.sin(roll)
    jacobian[:, 0, 5] = 1.0
    jacobian[:, 3:, :3] = SE3.rotation(delta).mT
    return _propagated(jacobian, cov)


def _propagated(jacobian: Array, cov: Array) -> Array:
    return jacobian @ cov @ jacobian.mT
