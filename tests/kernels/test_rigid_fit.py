"""The fit of a shape to points against the same Gauss-Newton written with NumPy's solver and inverse."""

import numpy as np
import pytest

from rbpf.kernels.rigid_fit import rigid_fit
from rbpf.lie import SE3
from rbpf.maps.joint_columns import by_frame

ROUNDS, SETTLED = 20, 1e-10


def twin(world, cov, shape, weight, start):
    """Frame, its derivative by the points, its covariance given them, and that of all."""
    frame = np.repeat(start, len(world), axis=0)
    for _ in range(ROUNDS):
        local = SE3.inverse_transform(frame[:, None], world)
        moved = -by_frame(SE3, local)
        weighed = np.swapaxes(moved, -1, -2) @ weight
        info = (weighed @ moved).sum(axis=1)
        vector = (weighed @ (local - shape)[..., None]).sum(axis=1)
        step = -np.linalg.solve(info, vector)[..., 0]
        frame = SE3.retract(frame, step)
        if np.abs(step).max() <= SETTLED:
            break
    back = np.swapaxes(SE3.rotation(frame), -1, -2)
    by_point = -np.linalg.solve(info[:, None], weighed @ back[:, None])
    slope = np.moveaxis(by_point, 1, 2).reshape(len(frame), 6, -1)
    left = np.linalg.inv(info)
    return frame, slope, left, slope @ cov @ np.swapaxes(slope, -1, -2) + left


@pytest.mark.parametrize("flat", [False, True], ids=["in space", "in a plane"])
@pytest.mark.parametrize("apart", [1e-3, 0.5])
def test_equals_numpys(apart, flat):
    rng, n, m = np.random.default_rng(3), 9, 5
    shape = rng.normal(size=(m, 3)) * ([1.0, 1.0, 0.0] if flat else [1.0, 1.0, 1.0])
    root = rng.normal(scale=0.01, size=(m, 3, 4))
    weight = np.linalg.inv(root @ np.swapaxes(root, -1, -2))
    start = SE3.exp(np.array([[0.4, -0.8, 1.2, 2.0, -1.0, 0.5]]))
    frames = SE3.retract(start, rng.normal(scale=apart, size=(n, 6)))
    world = SE3.transform(frames[:, None], shape + rng.normal(scale=0.02, size=(n, m, 3)))
    half = rng.normal(scale=0.003, size=(n, 3 * m, 20))
    cov = half @ np.swapaxes(half, -1, -2)
    found = (np.empty((n, 7)), np.empty((n, 6, 3 * m)), np.empty((n, 6, 6)), np.empty((n, 6, 6)))
    rigid_fit(world, cov, shape, weight, start, ROUNDS, SETTLED, *found)
    for part, expected in zip(found, twin(world, cov, shape, weight, start), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(part / scale, expected / scale, rtol=0.0, atol=1e-8)
    for covs in found[2:]:
        np.testing.assert_array_equal(covs, np.swapaxes(covs, -1, -2))
