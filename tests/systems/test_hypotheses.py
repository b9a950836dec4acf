"""A robot among landmarks without names, on a joint map."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.hypotheses import come_back, corridor
from examples.studies.soak import held_bytes
from rbpf.errors import InputError
from rbpf.runs.recordings import filter_opened, open_robot_log
from rbpf.systems.range_bearing.config import AssociationConfig, RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

CONFIG = RangeBearingConfig(particles=10, association="ml", map="joint")


@pytest.mark.slow
def test_of_two_equal_doors_the_right_one_is_found_and_none_is_given_up_before():
    several, single = ([come_back(seed, most) for seed in range(6)] for most in (4, 1))
    assert max(found.error_m for found in several) < 0.2
    assert min(found.kept for found in several) == min(found.rivals for found in several) == 1.0
    assert {found.left for found in several} == {1}
    assert sum(found.error_m > 3.0 for found in single) >= 2


@pytest.mark.parametrize("submap", [150, 7])
def test_where_nothing_is_ambiguous_it_is_the_run_that_knows_the_names(submap):
    """So it is when readings are of landmarks that only finished sub-maps have."""
    log = simulated_log(RobotWorld(steps=20, landmarks=12, std_translation_m=0.01), 1)
    unnamed = filter_opened(open_robot_log(log, replace(CONFIG, submap=submap)))
    named = filter_opened(open_robot_log(log, replace(CONFIG, submap=submap, association="known")))
    assert isinstance(unnamed.system, RangeBearingSlam)
    assert bool(unnamed.system.joint.old.maps) == (submap < 150)
    pairs = {(a, b) for f, ids in zip(log.frames, unnamed.system.associations(), strict=True)
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


def test_measurements_that_are_none_are_refused_before_anything_moves():
    log = corridor(0)
    slam = RangeBearingSlam(CONFIG, log.space, "position")
    slam.take(log.frames[0])
    with pytest.raises(InputError, match="measures 2 numbers"):
        slam.take(replace(log.frames[1], z=np.zeros((1, 3))))
    with pytest.raises(InputError, match="not finite"):
        slam.take(replace(log.frames[1], z=log.frames[1].z * np.nan))
    assert slam.filter.steps == 1
