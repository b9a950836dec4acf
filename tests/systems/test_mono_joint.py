"""One camera whose first frames become a joint map: nothing is lost by it, and it stays honest."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, RoomWorld, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_features
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig, VelocityConfig
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.mono.start.adjustment import FirstFrames
from tests.systems.mono_logs import desk, errors, nees, without_known
from tests.systems.plane_sequences import CAMERA, sequence

JOINT = MonoConfig(map="joint", settled_frames=4)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("ratio", [1.0, 1e-12], ids=["points", "rays"])
def test_the_joint_map_is_the_gaussian_about_the_optimum(known, ratio):
    """Its mean moves with the optimum, from which numeric derivatives; its covariance is what that makes of an error."""
    log = desk(3, frames=12, measurements=20)
    config = replace(JOINT, settled_frames=100, calibrate="online" if known else "off")
    slam = filter_features(log if known else without_known(log), config).system
    hand_over = slam.hand_over
    names, seen, best = hand_over._adjusted(slam.filter, slam.features)
    hand_over.config = replace(config, inverse_depth=InverseDepthConfig(promote_std_ratio=ratio))

    def begun(structure, information):
        new = hand_over._use(
            hand_over._new_filter(hand_over._rays, slam.sensor, slam.filter.rng), hand_over._rays, slam.sensor
        )
        revision = hand_over._begin(new, names, seen, replace(best, structure=structure, information=information))
        np.testing.assert_allclose(revision.poses[-1], new.belief().map.origin, atol=1e-12)
        return new.belief().map

    # cov = s sᵀ + η, by which all is known well enough for a point, or for none.
    step = 1e-4 * np.random.default_rng(0).normal(size=len(best.information))
    least, size = 1e-9 * step @ step, step.size
    information = (np.eye(size) - np.outer(step, step) / (least + step @ step)) / least
    one, here, other = (begun(best.structure.moved(sign * step), information) for sign in (-1.0, 0.0, 1.0))
    moved = (other.mean - one.mean)[0] / 2.0
    moved[:6] = SE3.local(one.origin, other.origin) / 2.0
    is_ray = here.are(here.ids, hand_over._rays.landmark)
    assert is_ray.sum() == (0 if ratio == 1.0 else here.ids.size - 4 * known) and here.ids.size > 15
    found = here.cov[: moved.size, : moved.size].copy()
    found[6:12, 6:12] -= np.diag(config.velocity.walk_std() ** 2) * 0.1 / 3.0  # the walk since the last frame
    std = np.sqrt(np.square(moved) + 1e-6 * step @ step)
    np.testing.assert_allclose(found / np.outer(std, std), np.outer(moved / std, moved / std), atol=0.01)


def test_the_longer_ago_the_fewer_frames_are_kept():
    first = FirstFrames()
    for t in range(200):
        first.note(FeatureFrame(t, np.array([t // 50]), np.zeros((1, 2)), np.eye(2)[None]), SE3.identity())
        first.thin(40)
    kept = [frame.stamp_ns for frame in first.seen]
    assert len(kept) == 40 and kept[0] == 0 and kept[-10:] == list(range(190, 200)) and len(first.stamps_ns) == 200
    assert (np.diff(kept) <= 1 + (200 - np.array(kept[:-1])) / 6).all()  # 40 that lie further apart the longer ago
    names, poses = first.seen_first(np.arange(200.0)[:, None] * np.ones(7))
    np.testing.assert_array_equal(names, range(4))
    assert poses[0, 0] == 0.0 and (np.diff(poses[:, 0]) >= 40).all()


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
    slam = MonoSlam(CAMERA, replace(JOINT, particles=20), None)
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
    mapped = whole.system.map()
    missing = set(mapped.ids[~mapped.is_ray()]) - set(submaps.system.map().ids)
    # Rays that are out of view when a sub-map is left are dropped; one Gaussian of all may know them later.
    assert len(missing) < 3


def test_what_is_refused():
    with pytest.raises(InputError, match=r"set velocity\.mode=marginal, not paper"):
        MonoSlam(CAMERA, replace(JOINT, velocity=VelocityConfig("paper")))
