"""A robot among landmarks without names, on a joint map."""

import time
from dataclasses import replace

import numpy as np
import pytest

from examples.studies.hypotheses import come_back, corridor
from examples.studies.soak import held_bytes
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.runs.recordings import filter_opened, open_robot_log, part_of_log
from rbpf.runs.truth import poses_at
from rbpf.sensors.readers import Frame, Part, RobotLog
from rbpf.systems.map_estimate import Anchored, relative_estimate
from rbpf.systems.range_bearing.config import AssociationConfig, CalibrationConfig, RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

CONFIG = RangeBearingConfig(particles=10, association="ml", map="joint")


@pytest.mark.slow
def test_of_two_equal_doors_the_right_one_is_found_and_none_is_given_up_before():
    several, single = ([come_back(seed, most) for seed in range(3)] for most in (4, 1))
    assert max(found.error_m for found in several) < 0.2
    assert min(found.kept for found in several) == min(found.rivals for found in several) == 1.0
    assert {found.left for found in several} == {1} and sum(found.error_m > 3.0 for found in single) >= 2


@pytest.mark.parametrize("submap", [150, 7])
def test_where_nothing_is_ambiguous_it_is_the_run_that_knows_the_names(submap):
    """So it is when readings are of landmarks that only finished sub-maps have."""
    log = simulated_log(RobotWorld(steps=20, landmarks=12, std_translation_m=0.01), 1)
    unnamed = filter_opened(open_robot_log(log, replace(CONFIG, submap=submap)))
    named = filter_opened(open_robot_log(log, replace(CONFIG, submap=submap, association="known", calibrate="off")))
    assert isinstance(unnamed.system, RangeBearingSlam)
    assert bool(unnamed.system.joint.old.maps) == (submap < 150)
    pairs = {(a, b) for f, ids in zip(log.frames, unnamed.system.hypotheses.held[0].chosen, strict=True)
             for a, b in zip(f.landmarks.tolist(), ids.tolist(), strict=True)}  # fmt: skip
    names, ids = ({pair[i] for pair in pairs} for i in (0, 1))
    assert len(pairs) == len(names) == len(ids) > 4
    np.testing.assert_allclose(unnamed.log.poses, named.log.poses, atol=1e-12)
    np.testing.assert_allclose(unnamed.log.covs, named.log.covs, atol=1e-14)
    assert (unnamed.log["hypotheses"] == 1).all()
    new = np.log(CONFIG.unknown.new_density)
    if submap < 150:
        return
    gained = unnamed.log["log_evidence"].sum() - named.log["log_evidence"].sum()
    assert gained == pytest.approx(len(names) * new, abs=1e-8)


def test_it_holds_no_more_for_having_seen_more():
    log = corridor(0)
    slam, held = RangeBearingSlam(CONFIG, log.space, "position"), {}
    still = log.frames[0]
    for t in range(65):
        nothing = replace(still, delta=log.space.identity(), cov_delta=1e-6 * np.eye(3)) if t else still
        slam.take(replace(nothing, stamp_ns=t))
        held[t] = held_bytes(slam) if t in (24, 64) else 0
    assert held[64] < 1.1 * held[24]


def test_a_landmark_that_should_be_seen_and_is_not_is_dropped():
    log = corridor(0)
    seen = log.frames[0]
    unknown = AssociationConfig(miss=1.0, drop=-0.5)
    slam = RangeBearingSlam(replace(CONFIG, unknown=unknown), log.space, "position")
    slam.take(seen)
    for t in range(1, 4):
        again = replace(seen, stamp_ns=t, delta=log.space.identity(), cov_delta=1e-6 * np.eye(3))
        slam.take(replace(again, z=seen.z[1:], cov_z=seen.cov_z[1:], landmarks=seen.landmarks[1:]))
    assert len(slam.map().ids) == len(slam.filter.belief().map.ids) == len(seen.z) - 1


ONLINE, OWN = {"calibrate": "online"}, {"map": "particles"}
NAMED = ONLINE | {"association": "known"}


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        (OWN, "association=ml needs a joint map: leave out map=particles and lag"),
        ({"map": "auto", "lag": 5}, "association=ml needs a joint map"),
        (ONLINE, "calibrate=online takes a joint map of landmarks with names"),
        ({"association": "known"} | ONLINE | OWN, "calibrate=online takes .*: leave out map=particles, lag"),
        (
            NAMED | {"self_calibration": CalibrationConfig(x_m=0, y_m=0, heading_deg_per_m=0, turn=0)},
            "nothing to estimate",
        ),
    ],
)
def test_what_takes_a_joint_map_or_names_is_refused_without(setting, told):
    with pytest.raises(InputError, match=told):
        RangeBearingSlam(replace(CONFIG, **setting))


def test_measurements_that_are_none_are_refused_before_anything_moves():
    log = corridor(0)
    slam = RangeBearingSlam(CONFIG, log.space, "position")
    slam.take(log.frames[0])
    with pytest.raises(InputError, match="must hold numbers of shape"):
        slam.take(replace(log.frames[1], z=np.zeros((1, 3))))
    with pytest.raises(InputError, match="must hold finite numbers"):
        slam.take(replace(log.frames[1], z=log.frames[1].z * np.nan))
    assert slam.filter.steps == 1


# The robot's system: wrong readings after a blind turn and as the first one of a landmark, many readings at once.

WORLD = RobotWorld(
    steps=330, landmarks=40, radius_m=2.0, extent_m=5.0, max_range_m=6.0, half_field_of_view_deg=30.0,
    std_range_m=0.12, std_angle_deg=1.1, std_translation_m=0.01, std_rotation_deg=1.1,
)  # fmt: skip
BLIND, LAST, WRONG = (100, 260), 310, 0.03
"""Steps without a reading, the last step, and the fraction of wrong readings."""


def blind_turn(seed: int) -> RobotLog:
    """One or two landmarks a step, after the turn new ones alone: the heading by odometry has σ of 14° there."""
    log, rng = simulated_log(WORLD, seed), np.random.default_rng(seed)
    before, after = part_of_log(log, Part(end_s=BLIND[0])).frames, part_of_log(log, Part(BLIND[1], LAST)).frames
    gap = part_of_log(log, Part(BLIND[0], BLIND[1], BLIND[1] - BLIND[0])).frames[1]
    known = {name for frame in before for name in frame.landmarks.tolist()}

    def seen(frame: Frame) -> Frame:
        again = np.isin(frame.landmarks, list(known)) & (frame.stamp_ns >= BLIND[1])
        rows = rng.permutation(np.flatnonzero(~again))[: rng.integers(1, 3)]
        z = frame.z[rows]
        wrong = rng.random(len(z)) < WRONG
        z[wrong] = rng.uniform([1.0, -0.5], [6.0, 0.5], (int(wrong.sum()), 2))
        return replace(frame, landmarks=frame.landmarks[rows], z=z, cov_z=frame.cov_z[rows])

    frames = [*before, gap, *after[1:]]
    return replace(log, frames=[seen(frame) for frame in frames], misread=True)


@pytest.mark.slow
def test_wrong_readings_do_not_choose_the_heading():
    """NEES over the seeds, 0.77; by a Gaussian likelihood 1.45, for the first wrong reading leaves one heading of many."""
    nees = []
    for seed in range(8):
        log = blind_turn(seed)
        run = filter_opened(open_robot_log(log, RangeBearingConfig(seed=seed)))
        _, truth = poses_at(SE2, log.truth.stamps_ns, log.truth.poses, run.log.stamps_ns)
        after = run.log.stamps_ns >= BLIND[1]
        error = SE2.between(truth, run.log.poses)[after, 0]
        nees.append((np.square(error) / run.log.covs[after, 0, 0]).mean())
    assert np.mean(nees) < 1.0


@pytest.mark.parametrize("first", [0, 1], ids=["first frame", "later"])
def test_a_landmark_is_begun_anew_when_its_second_reading_contradicts_the_first(first):
    """Else all that is seen of it later would be taken for wrong, and a start for known that is not."""
    log = simulated_log(RobotWorld(steps=40), 0)
    names = [frame.landmarks.tolist() for frame in log.frames]
    step = next(t for t, seen in enumerate(names) if t >= first and set(seen) - set().union(*names[:t]))
    name = sorted(set(names[step]) - set().union(*names[:step]))[0]
    z = log.frames[step].z.copy()
    z[names[step].index(name)] += [2.0, 0.5]
    log.frames[step] = replace(log.frames[step], z=z)
    run = filter_opened(open_robot_log(replace(log, misread=True), RangeBearingConfig()))
    found = run.system.map()
    error = found.mean[found.ids == name][0] - run.truth.landmarks[name]
    assert np.linalg.norm(error) < 0.15
    assert np.linalg.norm(run.log.poses[:, 1:] - run.truth.poses[:, 1:], axis=1).max() < 0.2


def test_many_first_sightings_in_one_frame_take_time_in_proportion_to_their_number():
    """30,000 names, the last one twice: the second time tells nothing in the frame that starts the landmark."""
    rng, seconds = np.random.default_rng(0), list[float]()
    for count in (3_000, 3_000, 30_000):
        z = np.stack([rng.uniform(1.0, 100.0, count), rng.uniform(-3.0, 3.0, count)], axis=1)
        cov_z, names = np.broadcast_to(np.diag([1e-2, 1e-3]), (count, 2, 2)), np.minimum(np.arange(count), count - 2)
        slam = RangeBearingSlam(RangeBearingConfig(particles=2, map="particles"))
        started = time.process_time()
        used = slam.track(z, cov_z, names).observed["landmarks"]
        seconds.append(time.process_time() - started)
    # 10 to 27 times, by the memory; some 60 if each is compared with all before it.
    assert seconds[2] < 45.0 * seconds[1] and used.tolist() == [*range(count - 1), -1]
    assert slam.track(z[-2:], cov_z[-2:], names[-2:]).observed["landmarks"].tolist() == [count - 2] * 2


# Poses relative to a frame that each particle knows in its own world, up to a covariance.


@pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
def test_covariance_of_the_frame_is_turned_into_the_poses_chart(space):
    """Against samples of x_0 = mean Exp(F e) of one particle."""
    rng, d = np.random.default_rng(0), space.dim
    anchored = Anchored(space.exp(rng.normal(size=(1, d))), 0.02 * rng.normal(size=(1, d, d + 1)))
    state = space.compose(anchored.mean, space.exp(np.full(d, 0.7)))
    found = relative_estimate(space, anchored, state, np.zeros(1))
    n, factor = 100_000, anchored.factor[0]
    noise = np.random.default_rng(1).standard_normal((n, factor.shape[1]))
    moved = space.between(space.retract(anchored.mean, noise @ factor.T), state)
    errors = space.local(found.mean, moved)
    scale = np.sqrt(np.outer(np.diag(found.cov), np.diag(found.cov)))
    assert (np.abs(np.cov(errors.T) - found.cov) / scale).max() < 0.05
    assert (np.abs(factor @ factor.T - found.cov) / scale).max() > 0.1
