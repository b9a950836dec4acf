"""The robot's system: wrong readings after a blind turn and as the first one of a landmark, many readings at once."""

import time
from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE2
from rbpf.runs.recordings import filter_opened, open_robot_log, part_of_log
from rbpf.runs.truth import poses_at
from rbpf.sensors.readers import Frame, Part, RobotLog
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

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


def headings(seed: int, config: RangeBearingConfig) -> tuple[np.ndarray, np.ndarray]:
    """Error and σ of the heading (T,) after the turn."""
    log = blind_turn(seed)
    run = filter_opened(open_robot_log(log, replace(config, seed=seed)))
    _, truth = poses_at(SE2, log.truth.stamps_ns, log.truth.poses, run.log.stamps_ns)
    after = run.log.stamps_ns >= BLIND[1]
    return SE2.between(truth, run.log.poses)[after, 0], np.sqrt(run.log.covs[after, 0, 0])


@pytest.mark.slow
def test_wrong_readings_do_not_choose_the_heading():
    """NEES over the seeds; by a Gaussian likelihood it is 8, for the first wrong reading leaves one heading of many."""
    found = [headings(seed, RangeBearingConfig()) for seed in range(8)]
    assert np.mean([np.square(error / sigma).mean() for error, sigma in found]) < 3.0


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
    count = 30_000
    rng = np.random.default_rng(0)
    z = np.stack([rng.uniform(1.0, 100.0, count), rng.uniform(-3.0, 3.0, count)], axis=1)
    cov_z = np.broadcast_to(np.diag([1e-2, 1e-3]), (count, 2, 2))
    names = np.minimum(np.arange(count), count - 2)
    slam = RangeBearingSlam(RangeBearingConfig(particles=2, map="particles"))
    started = time.process_time()
    used = slam.track(z, cov_z, names).observed["landmarks"]
    assert time.process_time() - started < 2.0  # 0.3 s; 4 s if each is compared with all before it
    assert used.tolist() == [*range(count - 1), -1]
    assert slam.track(z[-2:], cov_z[-2:], names[-2:]).observed["landmarks"].tolist() == [count - 2] * 2
