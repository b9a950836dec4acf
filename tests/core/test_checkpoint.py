"""A run that was saved and resumed is the run that was never interrupted, byte for byte."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import EssTriggered, Residual
from rbpf.errors import InputError
from tests.core.worlds import Recipe, World, content, drive, planar_world, same

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

    save(-1, None)
    reports = drive(uninterrupted, world, after=save)
    for t in range(-1, STEPS - 1, 4):
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


def test_arrays_of_the_caller_come_back(world, tmp_path):
    filter_ = Recipe(n=15).build()
    drive(filter_, world, 0, 3)
    extra = {"frame": np.array(17), "names": np.array(["a", "bc"]), "deep/er": np.arange(6.0).reshape(2, 3)}
    filter_.save(tmp_path / "run.npz", extra)
    found = Recipe(n=15).build().load(tmp_path / "run.npz")
    assert found.keys() == extra.keys()
    assert all(np.array_equal(found[name], extra[name]) for name in extra)


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


@pytest.mark.parametrize("stopped", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
def test_a_write_that_fails_or_is_killed_leaves_the_old_file(world, tmp_path, monkeypatch, stopped):
    filter_, path = Recipe(n=5).build(), tmp_path / "run.npz"
    drive(filter_, world, 0, 4)
    filter_.save(path)
    before = path.read_bytes()
    drive(filter_, world, 4, 8)

    def half(file, *args, **arrays):
        file.write(b"PK half of an archive")
        raise stopped

    monkeypatch.setattr(np, "savez", half)
    with pytest.raises((InputError, KeyboardInterrupt)) as caught:
        filter_.save(path)
    monkeypatch.undo()
    assert caught.type is KeyboardInterrupt or re.search(r"run\.npz cannot be written: .*No space", str(caught.value))
    assert path.read_bytes() == before
    filter_.save(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


def test_a_place_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere/run\.npz cannot be written"):
        Recipe(n=3).build().save(tmp_path / "nowhere" / "run.npz")
