"""The batch solution: GTSAM's charts, the factors, and the optimum against SciPy and an EKF."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.readers.measurements import InitialEstimate, dead_reckoning, initial_estimate
from rbpf.validation.gtsam.batch_problem import solve_problem
from rbpf.validation.gtsam.robot import CHUNK, solve, solve_online
from rbpf.validation.gtsam.stated import DOUBTFUL, measured_calibration
from tests.validation.worlds import assert_same, seen, solve_by_scipy, world

WORLDS = [
    (2, "range_bearing", False),
    (2, "position", False),
    (2, "range_bearing", True),
    (3, "range_bearing", False),
    (3, "position", True),
]


@pytest.mark.parametrize("noise", [1.0, 1e-3])
@pytest.mark.parametrize(("dim", "kind", "singular"), WORLDS)
def test_the_optimum_and_its_covariance_are_scipys(dim, kind, singular, noise):
    m = world(dim, kind, singular, noise=noise)
    found = solve(m)
    assert sorted(found.landmarks) == np.unique(m.landmarks).tolist()
    assert_same(found, solve_by_scipy(m), m.space, error=1e-9, path=1e-6 * noise, points=1e-6 * noise, cov=1e-5)


def test_the_start_is_known_and_a_robot_that_cannot_slip_does_not():
    m = world(2, "range_bearing", singular=True)
    found = solve(m)
    np.testing.assert_array_equal(found.cov_poses[0], np.zeros((3, 3)))
    np.testing.assert_allclose(found.world_from_body[0], m.start, atol=1e-12)
    predicted = m.space.compose(found.world_from_body[:-1], m.deltas)
    slipped = m.space.local(predicted, found.world_from_body[1:]) @ np.linalg.eigh(m.covs[0])[1][:, 0]
    assert np.abs(slipped).max() < 1e-9


@pytest.mark.slow
def test_a_robust_loss_is_opt_in_and_is_hubers():
    m = world(2, "range_bearing")
    z = m.z.copy()
    z[5] += [3.0, 0.5]
    bad = replace(m, z=z)
    plain, robust, clean = solve(bad), solve(bad, robust=1.345), solve(m)
    expected = solve_by_scipy(bad, robust=1.345)
    assert robust.error == pytest.approx(expected.error, rel=1e-9)
    # SciPy's numeric derivatives stop a little short of the kinked loss' minimum.
    assert np.abs(SE2.local(expected.world_from_body, robust.world_from_body)).max() < 1e-4
    off = [
        np.linalg.norm(s.landmarks[int(m.landmarks[5])] - clean.landmarks[int(m.landmarks[5])]) for s in (plain, robust)
    ]
    assert off[0] > 5 * off[1]


@pytest.mark.slow
def test_any_start_near_by_leads_to_the_same_optimum():
    m = world(2, "range_bearing", steps=CHUNK + 10)
    expected = solve(m)
    rng = np.random.default_rng(4)
    moved = SE2.retract(expected.world_from_body, 0.05 * rng.normal(size=expected.cov_poses.shape[:2]))
    points = {name: point + 0.05 * rng.normal(size=2) for name, point in expected.landmarks.items()}
    for found in (solve(m, initial=InitialEstimate(moved, points)), solve(m, incremental=True)):
        assert found.error == pytest.approx(expected.error, rel=1e-9)
        assert np.abs(SE2.local(expected.world_from_body, found.world_from_body)).max() < 1e-6


@pytest.mark.parametrize(("dim", "kind", "singular"), WORLDS[1:4])
def test_a_sensor_that_stands_or_measures_otherwise_than_stated_is_found(dim, kind, singular):
    """And none that is where it is said to be; who always turns alike cannot tell, and noise does not make it so."""
    for winding, turn, away, longer in ((False, 0.0, 0.0, 1.0), (True, 0.0, 0.0, 1.0), (True, 0.04, 0.1, 1.03)):
        m = world(dim, kind, singular, steps=30, noise=0.1, winding=winding)
        z, place = m.z.copy(), m.robot_from_sensor.copy()
        z[:, : 1 if kind == "range_bearing" else None] *= longer
        place[-dim:] += away
        off = m.space.exp(np.concatenate([np.zeros(m.space.dim - dim - 1), [turn], np.zeros(dim)]))
        stated = replace(m, z=z, robot_from_sensor=m.space.compose(place, off))
        found = measured_calibration(solve_problem(stated, initial_estimate(stated).world_from_body))
        assert (max((one.apart for one in found), default=0.0) > 2.0 * DOUBTFUL) == bool(away)
        if winding:
            right = [found[-dim - 2].stated - np.rad2deg(turn), *m.space.translation(m.robot_from_sensor), longer]
            assert max(o._replace(stated=r).apart for o, r in zip(found[-dim - 2 :], right, strict=True)) < 4.0


def first_steps(m, count):
    """What had been measured after so many steps."""
    rows = m.steps < count
    kept = {name: getattr(m, name)[rows] for name in ("steps", "landmarks", "z", "cov_z")}
    return replace(m, stamps_ns=m.stamps_ns[:count], deltas=m.deltas[: count - 1], covs=m.covs[: count - 1], **kept)


@pytest.mark.slow
def test_the_online_optimum_knows_nothing_of_the_future():
    m = world(2, "range_bearing", singular=True, steps=15)
    found = solve_online(m)
    for step in (5, 9, 14):
        then = solve(first_steps(m, step + 1))
        off = m.space.local(then.world_from_body[-1], found[step])
        assert (np.abs(off) < 0.1 * np.sqrt(np.diag(then.cov_poses[-1]))).all()
    whole = solve(m)
    early = m.space.local(whole.world_from_body[5], found[5])
    assert (np.abs(early) > 0.3 * np.sqrt(np.diag(whole.cov_poses[5]))).any()


@pytest.mark.parametrize("singular", [False, True])
def test_without_sightings_dead_reckoning_comes_back(singular):
    m = world(2, "position", singular)
    blind = seen(m, m.steps[:0], m.landmarks[:0], m.z[:0], m.cov_z[:0])
    found = solve(blind)
    np.testing.assert_allclose(found.world_from_body, dead_reckoning(m), atol=1e-12)
    assert found.landmarks == {}
    assert found.cov_landmarks == {}
    first = m.covs[0]
    np.testing.assert_allclose(found.cov_poses[1], first, atol=1e-12)
    back = SE2.adjoint(SE2.inverse(m.deltas[1]))
    np.testing.assert_allclose(found.cov_poses[2], back @ first @ back.T + m.covs[1], atol=1e-12)


def test_bad_input_is_refused_in_words():
    m = world(2, "range_bearing")
    cov_z = m.cov_z.copy()
    cov_z[3] = np.diag([0.01, 0.0])
    place = f"landmark {m.landmarks[3]} at step {m.steps[3]} "
    with pytest.raises(InputError, match=place + "has a singular covariance"):
        solve(replace(m, cov_z=cov_z))
    with pytest.raises(InputError, match="threshold above 0"):
        solve(m, robust=0.0)
    start = initial_estimate(m)
    with pytest.raises(InputError, match=re.escape("every landmark seen, landmark 7 is missing")):
        solve(m, initial=InitialEstimate(start.world_from_body, {k: v for k, v in start.landmarks.items() if k != 7}))
    with pytest.raises(InputError, match=re.escape("found poses of shape (3, 3)")):
        solve(m, initial=InitialEstimate(start.world_from_body[:3], start.landmarks))


def test_a_variable_that_is_not_determined_is_named():
    m = world(2, "range_bearing")
    m = replace(m, start=SE2.identity(), robot_from_sensor=SE2.identity())
    path, points = initial_estimate(m)
    at_the_sensor = InitialEstimate(path, {**points, int(m.landmarks[m.steps == 0][0]): np.zeros(2)})
    with (
        np.errstate(all="ignore"),
        pytest.raises(InputError, match=r"not determine everything near (landmark|the pose of step) \d+;"),
    ):
        solve(m, initial=at_the_sensor)
