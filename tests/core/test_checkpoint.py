"""A run that was saved and resumed is the run that was never interrupted, byte for byte."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import MotionModel, ObservationModel, Observations, Part, Sensor, Transition
from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import EssTriggered, Residual
from rbpf.errors import InputError
from rbpf.lie import Euclidean
from tests.core.worlds import STEP_NS, Recipe, World, content, drive, planar_world, same

STEPS = 30
RECIPES = {
    "known": Recipe(n=15),
    "unknown": Recipe(n=15, known=False),
    "lag": Recipe(n=15, options={"lag": 7}),
    "clouds": Recipe(n=15, options={"clouds": True}),
    "bootstrap": Recipe(n=15, options={"proposal": PriorProposal(), "resampler": EssTriggered(Residual(), 1.0)}),
    "numpy": Recipe(n=15, compiled=False),
}


@pytest.fixture(scope="module")
def world() -> World:
    return planar_world(STEPS, seed=4)


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES.keys())
def test_resumed_at_any_step(recipe, tmp_path):
    world = planar_world(STEPS, seed=4, clutter=0.0 if recipe.known else 0.5)
    uninterrupted = recipe.build()

    def save(t, report):
        if t % 4 == 3:
            uninterrupted.save(tmp_path / f"{t}.npz")

    reports = drive(uninterrupted, world, after=save)
    for t in range(3, STEPS - 1, 4):
        resumed = replace(recipe, seed=99).build()
        resumed.load(tmp_path / f"{t}.npz")
        again = drive(resumed, world, t + 1)
        assert same(content(resumed), content(uninterrupted))
        assert resumed.rng.bit_generator.state == uninterrupted.rng.bit_generator.state
        for before, after in zip(reports[t + 1 :], again, strict=True):
            assert before.estimate.mean.tobytes() == after.estimate.mean.tobytes()
            assert before.estimate.cov.tobytes() == after.estimate.cov.tobytes()
            for number in ("log_evidence", "ess", "nis"):
                np.testing.assert_equal(getattr(after, number), getattr(before, number))


def test_the_scenario_has_something_to_lose(world):
    filter_ = Recipe(n=15).build()
    reports = drive(filter_, world)
    arrays = filter_.marginals.arrays()
    assert sum(report.resampled for report in reports) >= 5
    assert any(name.endswith("/kept") for name in arrays)
    assert np.unique(arrays["store/generation"]).size > 1
    assert filter_.history.stored_states < STEPS * 15


def test_resumed_in_place_of_a_later_state(world, tmp_path):
    filter_, recipe = Recipe(n=15).build(), Recipe(n=15)
    drive(filter_, world, 0, 12)
    filter_.save(tmp_path / "at_12.npz")
    drive(filter_, world, 12)
    expected = content(filter_)
    filter_.load(tmp_path / "at_12.npz")
    assert filter_.steps == 12
    drive(filter_, world, 12)
    assert same(content(filter_), expected)
    untouched = recipe.build()
    untouched.load(tmp_path / "at_12.npz")
    assert untouched.steps == 12


def test_before_the_first_step(world, tmp_path):
    recipe = Recipe(n=15)
    recipe.build().save(tmp_path / "start.npz")
    resumed = replace(recipe, seed=7).build()
    resumed.load(tmp_path / "start.npz")
    assert resumed.stamp_ns is None
    uninterrupted = recipe.build()
    drive(resumed, world)
    drive(uninterrupted, world)
    assert same(content(resumed), content(uninterrupted))


@pytest.mark.parametrize("generator", [np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64])
def test_every_random_generator(generator, tmp_path):
    filter_ = Recipe(n=5).build()
    filter_.rng = np.random.Generator(generator(3))
    filter_.rng.standard_normal(7)
    filter_.save(tmp_path / "run.npz")
    resumed = Recipe(n=5).build()
    resumed.rng = np.random.Generator(generator(4))
    resumed.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(resumed.rng.random(20), filter_.rng.random(20))


class Drift(MotionModel):
    """A position driven by a velocity that is marginalised."""

    space = Euclidean(1)

    def transition(self, state, control, dt):
        factor = np.diag([0.1, 0.05])[None]
        return Transition(state, factor, np.full((1, 1, 1), dt), np.eye(1)[None], np.zeros((1, 1)))


class Speedometer(ObservationModel):
    """Position and velocity."""

    dim = 2
    reads = frozenset({Part.STATE, Part.SUBSTATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return np.concatenate(np.broadcast_arrays(state, substate), axis=-1)


class Direct(Sensor):
    """Frames are the measurements."""

    def observe(self, frame, belief):
        return [Observations(frame[None], 0.04 * np.eye(2)[None], Speedometer())]


def driven(seed: int) -> Filter:
    substate = KalmanSubstate(Drift.space, np.zeros(1), np.eye(1))
    return Filter(Drift(), Direct(), substate, n=20, rng=np.random.default_rng(seed))


def test_with_a_substate(tmp_path):
    rng = np.random.default_rng(5)
    frames = np.stack([np.linspace(0, 3, 25), np.ones(25)], axis=-1) + 0.2 * rng.normal(size=(25, 2))
    uninterrupted = driven(1)
    for t, frame in enumerate(frames):
        uninterrupted.step(frame, None, t * STEP_NS)
        uninterrupted.save(tmp_path / f"{t}.npz")
    for t in (0, 9, 20):
        resumed = driven(2)
        resumed.load(tmp_path / f"{t}.npz")
        for late in range(t + 1, 25):
            resumed.step(frames[late], None, late * STEP_NS)
        assert same(content(resumed), content(uninterrupted))


def test_arrays_of_the_caller_come_back(world, tmp_path):
    filter_ = Recipe(n=15).build()
    drive(filter_, world, 0, 3)
    extra = {"frame": np.array(17), "names": np.array(["a", "bc"]), "deep/er": np.arange(6.0).reshape(2, 3)}
    filter_.save(tmp_path / "run.npz", extra)
    found = Recipe(n=15).build().load(tmp_path / "run.npz")
    assert found.keys() == extra.keys()
    assert all(np.array_equal(found[name], extra[name]) for name in extra)


def test_no_pickle_is_written(world, tmp_path):
    filter_ = Recipe(n=5).build()
    drive(filter_, world, 0, 5)
    filter_.save(tmp_path / "run.npz")
    with zipfile.ZipFile(tmp_path / "run.npz") as archive:
        for name in archive.namelist():
            assert b"'descr': '|O'" not in archive.read(name)[:200]


@pytest.mark.parametrize(
    "array",
    [
        np.array([object()]),
        np.array([1j]),
        np.array([b"abc"]),
        np.array(["2026-01-01"], dtype="M8[D]"),
        np.zeros(2, dtype=[("a", float)]),
        np.array(["\ud800"]),
        np.array([7], dtype=np.uint8).view(bool),
    ],
    ids=lambda array: str(array.dtype),
)
def test_what_load_would_refuse_is_not_saved(array, tmp_path):
    filter_ = Recipe(n=3).build()
    with pytest.raises(InputError, match=r"run\.npz cannot be written: the array extra/thing: "):
        filter_.save(tmp_path / "run.npz", {"thing": array})
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file(world, tmp_path, monkeypatch):
    filter_, path = Recipe(n=5).build(), tmp_path / "run.npz"
    drive(filter_, world, 0, 4)
    filter_.save(path)
    before = path.read_bytes()
    drive(filter_, world, 4, 8)

    def full_disk(file, *args, **arrays):
        file.write(b"PK half of an archive")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(InputError, match=r"run\.npz cannot be written: .*No space left"):
        filter_.save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


def test_a_killed_write_leaves_the_old_file(world, tmp_path, monkeypatch):
    filter_, path = Recipe(n=5).build(), tmp_path / "run.npz"
    drive(filter_, world, 0, 4)
    filter_.save(path)
    before = path.read_bytes()

    def killed(file, *args, **arrays):
        file.write(b"PK half of an archive")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", killed)
    with pytest.raises(KeyboardInterrupt):
        filter_.save(path)
    assert path.read_bytes() == before
    monkeypatch.undo()
    filter_.save(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


def test_a_place_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere/run\.npz cannot be written"):
        Recipe(n=3).build().save(tmp_path / "nowhere" / "run.npz")


def test_a_path_may_be_text(tmp_path):
    filter_ = Recipe(n=3).build()
    filter_.save(str(tmp_path / "run.npz"))
    assert filter_.load(str(tmp_path / "run.npz")) == {}
