"""Reading and projecting by drivers against the store's own columns and the models in NumPy."""

import numpy as np
import pytest

from rbpf.core.genealogy import Lineage
from rbpf.core.models import Belief, Part, Records
from rbpf.core.particles import Prior
from rbpf.lie import SE3
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint, CameraRay, EpipolarRay

CAMERA = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.1, 0.02, 0.001, -0.001, 0.0))


def grown(n: int, rng: np.random.Generator) -> tuple[LandmarkMap, Lineage, np.ndarray, np.ndarray]:
    """A map of points and rays of several generations, the first of which have gone cold."""
    lineage, landmark_map = Lineage(n), LandmarkMap(SE3)
    landmark_map.begin(n, lineage)
    points, rays = [], []
    for _ in range(6):
        spread = 0.02 * rng.normal(size=(n, 2, 3, 3))
        cov = spread @ np.swapaxes(spread, -1, -2)
        mean = rng.uniform([-1, -1, 3], [1, 1, 5], (2, 3)) + 0.02 * rng.normal(size=(n, 2, 3))
        points.append(landmark_map.add_records(Records(mean, cov), Point(3)))
        anchor = SE3.exp(0.02 * rng.normal(size=(n, 2, 6)))
        bearing = np.array([0.1, -0.1, 0.3]) + 0.02 * rng.normal(size=(n, 2, 3))
        rays.append(landmark_map.add_records(Records(bearing, cov, anchor), InverseDepth()))
        ancestors = np.sort(rng.integers(0, n, n))
        lineage.advance(ancestors)
        landmark_map.resample(ancestors)
    return landmark_map, lineage, np.concatenate(points), np.concatenate(rays)


@pytest.mark.parametrize("n", [7, 300])
def test_records_are_the_columns(n):
    landmark_map, _, points, rays = grown(n, np.random.default_rng(0))
    for ids, landmark in ((points[-6:], Point(3)), (rays[-6:], InverseDepth())):
        assert landmark_map.store.is_warm(ids[-2:])
        for chosen in (ids[-2:], ids):
            read = landmark_map.read(chosen)
            layout = landmark_map.layouts[0 if isinstance(landmark, Point) else 1]
            plain = layout.unpack(np.array([landmark_map.store.read(int(i)) for i in chosen]))
            np.testing.assert_array_equal(read.mean, plain.mean)
            np.testing.assert_array_equal(read.cov, plain.cov)
            if plain.const is not None:
                np.testing.assert_array_equal(read.const, plain.const)


@pytest.mark.parametrize("some", [slice(3, 4), slice(2, 6), np.array([5, 0, 5])], ids=str)
def test_records_of_some_particles(some):
    landmark_map, _, points, rays = grown(7, np.random.default_rng(1))
    for ids in (points[-2:], rays[-2:], points, rays):
        part, whole = landmark_map.read(ids, some), landmark_map.read(ids)
        np.testing.assert_array_equal(part.mean, whole.mean[some])
        np.testing.assert_array_equal(part.cov, whole.cov[some])
        if whole.const is not None:
            np.testing.assert_array_equal(part.const, whole.const[some])


@pytest.mark.parametrize("camera_model", [CameraPoint, CameraRay, EpipolarRay])
def test_innovations_in_the_heaviest_particle_equal_numpys(camera_model):
    rng, n, k = np.random.default_rng(4), 7, 4
    landmark_map, _, points, rays = grown(n, rng)
    ids = (points if camera_model is CameraPoint else rays)[-k:]
    state = SE3.exp(0.05 * rng.normal(size=(n, 6)))
    prior = Prior(SE3, state, np.zeros((1, 6)), np.zeros((1, 6, 6)))
    log_weights = np.log(np.arange(1.0, n + 1.0) / 28.0)
    belief = Belief(log_weights, prior, {Part.LANDMARK: landmark_map})
    model, z = camera_model(CAMERA), rng.uniform([200, 100], [400, 300], (k, 2))
    found = belief.innovations(model, z, ids)
    landmark_map.compiled = False
    for part, expected in zip(found, belief.innovations(model, z, ids), strict=True):
        assert part.shape == expected.shape
        np.testing.assert_allclose(part, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("n", [7, 300])
@pytest.mark.parametrize("shared", [True, False], ids=["one factor", "own factors"])
def test_projections_equal_numpys(n, shared):
    rng = np.random.default_rng(2)
    landmark_map, _, points, rays = grown(n, rng)
    factor = 0.01 * rng.normal(size=(1 if shared else n, 6, 6))
    prior = Prior(SE3, SE3.exp(0.02 * rng.normal(size=(n, 6))), 0.01 * rng.normal(size=(n, 6)), factor, centred=False)
    weights = rng.uniform(size=n)
    belief = Belief(np.log(weights / weights.sum()), prior, {Part.LANDMARK: landmark_map})
    # A constraint is projected by its prediction.
    assert not landmark_map.is_compiled(EpipolarRay(CAMERA), rays[-2:])
    for model, ids in ((CameraPoint(CAMERA), points[-2:]), (CameraRay(CAMERA), rays[-2:])):
        assert landmark_map.is_compiled(model, ids)
        mean, cov = belief.project(model, ids)
        landmark_map.compiled = False
        expected_mean, expected_cov = belief.project(model, ids)
        landmark_map.compiled = True
        np.testing.assert_allclose(mean, expected_mean, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(cov, expected_cov, rtol=1e-10, atol=1e-10)
