"""One camera whose particles hand their maps over to a joint one: nothing is lost by it, and it stays honest."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, RoomWorld, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.runs.recordings import filter_features
from rbpf.systems.mono.config import MonoConfig, VelocityConfig
from rbpf.systems.mono.slam import MonoSlam
from tests.systems.mono_logs import desk, errors, nees, without_known
from tests.systems.plane_sequences import CAMERA, sequence

JOINT = MonoConfig(map="joint", starting_particles=200, settled_frames=4)


@pytest.mark.parametrize("known", [True, False])
def test_what_the_particles_hold_is_handed_over(known):
    """Pose, landmarks and their covariances are the same after it as before, up to the second order."""
    log = desk(3, frames=45, measurements=20)
    slam = filter_features(log if known else without_known(log), replace(JOINT, settled_frames=100)).system

    def told():
        return slam.map(), slam.filter.n, SE3.mean(slam.particle_poses(), slam.filter.particles.weights)

    before, many, pose = told()
    evidence = slam.filter.log_evidence
    slam.filter = slam.hand_over.become(slam.filter, slam.sensor).filter
    after, few, same_pose = told()
    np.testing.assert_equal(slam.filter.log_evidence, evidence)
    assert (many, few) == (200, 50) and before.ids.size > 20
    np.testing.assert_array_equal(after.ids, before.ids)
    np.testing.assert_array_equal(after.is_ray(), before.is_ray())
    std = np.sqrt(np.einsum("kii->ki", before.cov))
    full = ~before.is_ray()
    assert (np.abs(after.mean - before.mean) < 0.2 * std + 1e-6)[full].all()
    ratio = np.trace(after.cov[full], axis1=1, axis2=2) / np.trace(before.cov[full], axis1=1, axis2=2)
    assert 0.6 < ratio.min() < ratio.max() < 1.6
    assert np.abs(SE3.local(pose, same_pose)).max() < 2e-3


@pytest.mark.parametrize("exact", [True, False])
def test_known_points_are_as_uncertain_one_by_one_as_together(exact):
    """By draws of the frame, or of the points, from what the group says."""
    rng, points = np.random.default_rng(0), np.random.default_rng(1).normal((0.0, 0.0, 3.0), 1.0, (4, 3))
    root = 0.01 * rng.normal(size=(6, 6))
    frame = SE3.exp(np.array([0.3, -0.2, 0.4, 1.0, 2.0, -1.0]))
    if exact:
        group = Constellation(points)
        found, cov = group.jointly(group.started(1, frame, root @ root.T))
        drawn = SE3.retract(frame, rng.normal(size=(20_000, 6)) @ root.T)
        moved = SE3.transform(drawn[:, None], points)
    else:
        group = UncertainConstellation(points, np.tile(1e-4 * np.eye(3), (4, 1, 1)))
        world = SE3.transform(frame, points)
        half = 0.01 * rng.normal(size=(12, 12))
        found, cov = group.jointly(group.started(1, world, half @ half.T))
        moved = world + (rng.normal(size=(20_000, 12)) @ half.T).reshape(-1, 4, 3)
        drawn = None
    np.testing.assert_allclose(found[0], frame, atol=1e-9)
    offset = (moved - SE3.transform(frame, points)).reshape(len(moved), 12)
    np.testing.assert_allclose(cov[0, 6:, 6:], np.cov(offset.T), atol=0.05 * np.abs(cov).max())
    if drawn is not None:
        both = np.concatenate([SE3.local(frame, drawn), offset], axis=1)
        np.testing.assert_allclose(cov[0], np.cov(both.T), atol=0.05 * np.abs(cov).max())


@pytest.mark.slow
def test_it_is_honest_where_the_baseline_was_hardly_known():
    """Recordings that a joint map from the first frame on gets wrong by decimetres."""
    scores, off = [], []
    for seed in (100, 103, 104):
        log = simulate_features(DeskWorld(frames=120), Measuring(), MONO, seed)
        run = filter_features(log, MonoConfig(map="joint", seed=seed))
        assert run.system.joint is not None
        scores.append(nees(run).mean() / 6.0)
        off.append(np.linalg.norm(errors(run)[60:, 3:], axis=1).mean())
    assert 0.5 < np.mean(scores) < 2.0 and max(off) < 0.03


def test_features_of_old_sub_maps_are_found_again():
    """What is put away is in the map all the time, and is looked for and found as it is in view."""
    slam = MonoSlam(CAMERA, replace(JOINT, particles=20, starting_particles=20), None)
    gone, held, found = np.arange(6), [], []
    for t, frame in enumerate(sequence(40).frames()):
        if t == 30:
            slam.joint.put_away(gone)
        slam.take(frame)
        if t >= 30:
            held.append(slam.joint.holds(gone).any())
            found.append(slam.sensor.table.found[gone].sum())
        if t == 31:
            assert np.isin(gone, slam.map().ids).all()
    assert not all(held) and held[-1] and found[-1] >= found[0] + gone.size


@pytest.mark.slow
def test_a_loop_closes_on_landmarks_of_old_sub_maps():
    """Once round a room, until the first landmarks are seen again: as good and as sure of itself as one Gaussian of all."""
    log = simulate_features(RoomWorld(frames=300, laps=1.3, points=300), Measuring(), MONO, 0)
    whole, submaps = (filter_features(log, MonoConfig(submap=most)) for most in (3000, 80))
    assert len(submaps.system.joint.old.maps) > 2 and submaps.log["points"].max() < whole.log["points"].max() / 2
    off = [np.linalg.norm(errors(run)[:, 3:], axis=1) for run in (whole, submaps)]
    assert off[1][-40:].mean() < 1.5 * off[0][-40:].mean() + 0.01
    assert nees(submaps).mean() < 1.2 * nees(whole).mean()
    mapped = whole.system.map()  # rays that are out of view when a sub-map is left are dropped
    assert set(mapped.ids[~mapped.is_ray()]) <= set(submaps.system.map().ids)


def test_what_is_refused():
    with pytest.raises(InputError, match=r"set velocity\.mode=marginal, not paper"):
        MonoSlam(CAMERA, replace(JOINT, velocity=VelocityConfig("paper")))
