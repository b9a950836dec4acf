"""What a group of observations updates: the particles, the landmarks, or both."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.filter import Filter, StepReport
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Observations, Part, Records
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Systematic
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import MixturePoint
from rbpf.motion.odometry import Odometry, OdometryMotion
from tests.exactness.models import Frame, Scripted
from tests.exactness.scenes import Scene, sensors

STATE, MAP = frozenset({Part.STATE}), frozenset({Part.LANDMARK})
PARTICLES = 40
every_space = pytest.mark.parametrize("space", [SE2, SE3], ids=repr)
every_path = pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "numpy"])
every_proposal = pytest.mark.parametrize(
    "proposal", [EkfProposal(), EkfProposal(exact=False), PriorProposal()], ids=["ekf", "linearised", "prior"]
)


def split(group: Observations) -> list[Observations]:
    """The same measurement twice: once for the state, once for the landmarks."""
    return [replace(group, updates=STATE), replace(group, updates=MAP)]


def scene(space, seed: int = 0) -> tuple[Scene, list[list[Observations]]]:
    """Four frames; three landmarks are measured in each."""
    rng = np.random.default_rng(seed)
    scene = Scene.random(space, rng, n=PARTICLES)
    model = sensors(space, rng)[0]
    return scene, [[scene.observe(model, rng.permutation(4)[:3])] for _ in range(4)]


def run(
    scene: Scene, frames: Sequence[Sequence[Observations]], compiled: bool = True, proposal=None, threshold: float = 0.6
) -> tuple[Filter, list[StepReport]]:
    held = LandmarkMap(scene.space, compiled=compiled)
    filter_ = Filter(
        OdometryMotion(scene.space),
        Scripted(),
        held,
        proposal,
        EssTriggered(Systematic(), threshold),
        PARTICLES,
        np.random.default_rng(5),
        scene.state,
    )
    held.add_records(scene.records, scene.map().landmark_of(0))
    noise = Odometry(scene.space.identity(), 2e-4 * np.eye(scene.space.dim))
    return filter_, [filter_.step(Frame(groups), noise) for groups in frames]


def landmarks(filter_: Filter) -> Records:
    held = filter_.belief().map
    return held.read(held.ids)


@every_path
@every_proposal
@every_space
def test_one_group_for_each_is_one_group_for_both(space, proposal, compiled):
    """E06 §5.2 with the same model in both: whole runs with resampling agree."""
    world, frames = scene(space)
    ((groups,), *_) = frames
    both, reports = run(world, frames, compiled, proposal)
    parted, others = run(world, [split(*groups) for groups in frames], compiled, proposal)
    assert both.lineage.generation == parted.lineage.generation > 0
    np.testing.assert_allclose(parted.particles.state, both.particles.state, atol=1e-9)
    np.testing.assert_allclose(parted.particles.log_weights, both.particles.log_weights, atol=1e-7)
    # Both parts of a measurement are its density; of the parts of two, that differ in a row or the noise, that is not said.
    assert [other.log_evidence for other in others] == pytest.approx([one.log_evidence for one in reports], abs=1e-7)
    assert np.isfinite(both.log_evidence)
    for change in ({"z": groups.z[::-1]}, {"cov": 2.0 * groups.cov}, {"ids": groups.ids[::-1]}):
        first, second = split(groups)
        assert np.isnan(run(world, [[first, replace(second, **change)]], compiled, proposal)[0].log_evidence)
    assert [other.rows for other in others] == [one.rows for one in reports]
    np.testing.assert_allclose(landmarks(parted).mean, landmarks(both).mean, atol=1e-9)
    np.testing.assert_allclose(landmarks(parted).cov, landmarks(both).cov, atol=1e-11)


@every_path
@every_proposal
@every_space
def test_for_the_landmarks_alone(space, proposal, compiled):
    """Particles move and weigh as without a measurement, to the bit; landmarks as with one for both there.
    With the test above this says as much of a group for the state: it moves and weighs, and leaves the landmarks."""
    world, (groups, *_) = scene(space)
    alone, (report,) = run(world, [split(*groups)[1:]], compiled, proposal)
    nothing, _ = run(world, [[]], compiled, proposal)
    assert alone.particles.state.tobytes() == nothing.particles.state.tobytes()
    assert alone.particles.log_weights.tobytes() == nothing.particles.log_weights.tobytes()
    assert nothing.log_evidence == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(report.log_evidence) and report.rows == 0
    assert np.isnan(run(world, [split(*groups)[:1]], compiled, proposal)[0].log_evidence)
    expected = world.map(compiled)
    expected.correct(alone.particles.state, np.zeros((PARTICLES, space.dim)), groups)
    np.testing.assert_array_equal(landmarks(alone).mean, expected.read(expected.ids).mean)
    np.testing.assert_array_equal(landmarks(alone).cov, expected.read(expected.ids).cov)
    assert np.abs(landmarks(alone).mean - world.records.mean).max() > 1e-3


@pytest.mark.parametrize(
    "updates", [frozenset(), frozenset({Part.SUBSTATE}), STATE | {Part.SUBSTATE}, {Part.STATE}, Part.STATE]
)
def test_what_cannot_be_informed(updates):
    world, (groups, *_) = scene(SE2)
    with pytest.raises(InputError, match=r"of RangeBearing inform a frozenset of Part\.STATE, Part\.LANDMARK or both"):
        run(world, [[replace(groups[0], updates=updates)]])


def mixture(world: Scene) -> LandmarkMap:
    held = LandmarkMap(SE2)
    held.begin(PARTICLES, Lineage(PARTICLES))
    mean, cov = (np.stack([part, part], axis=2) for part in (world.records.mean, world.records.cov))
    log_weights = np.full(mean.shape[:3], np.log(0.5))
    held.add_records(Records(mean, cov, None, log_weights), MixturePoint(2, 2))
    return held


def test_several_components_without_weighing():
    """The landmark's components are updated, the particles' weights are not; the other way round cannot be."""
    world, (groups, *_) = scene(SE2)
    zero = np.zeros((PARTICLES, SE2.dim))
    held, other = mixture(world), mixture(world)
    densities = held.correct(world.state, zero, split(*groups)[1:])
    expected = other.correct(world.state, zero, groups)
    np.testing.assert_array_equal(densities.all, 0.0)
    np.testing.assert_array_equal(densities.after_sampling, 0.0)
    assert np.ptp(expected.all) > 0.0
    np.testing.assert_array_equal(held.read(held.ids).mean, other.read(other.ids).mean)
    with pytest.raises(InputError, match="several components cannot be observed without being updated"):
        held.correct(world.state, zero, split(*groups)[:1])


def test_a_landmark_that_is_weighed_apart_and_updated_together_is_refused():
    world, (groups, *_) = scene(SE2)
    twice = [groups[0], replace(groups[0], updates=STATE)]
    with pytest.raises(InputError, match="updates the state alone and by one that updates both"):
        run(world, [twice])
