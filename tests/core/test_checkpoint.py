"""A run that was saved and resumed is the run that was never interrupted; what is no such file is told in one sentence."""

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import EssTriggered, Residual, Systematic
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import MixturePoint, Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
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
    assert sum(report.resampled for report in reports) >= 5 and any(name.endswith("/kept") for name in arrays)
    assert np.unique(arrays["store/generation"]).size > 1 and filter_.history.stored_states < STEPS * 15


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
    assert found.keys() == extra.keys() and all(np.array_equal(found[name], extra[name]) for name in extra)


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


RECIPE = Recipe(n=4)


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """A checkpoint after six steps."""
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    filter_ = RECIPE.build()
    drive(filter_, planar_world(6, seed=4))
    filter_.save(path)
    return path


@pytest.fixture(scope="module")
def target() -> Filter:
    """A filter that is one step on its way."""
    filter_ = RECIPE.build()
    drive(filter_, planar_world(1, seed=5))
    return filter_


def refused(filter_: Filter, path: Path, match: str) -> None:
    """Loading fails with one sentence that names the file, and changes nothing."""
    before, generator = content(filter_), filter_.rng.bit_generator.state
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a damaged array header can look like one of Python 2
        with pytest.raises(InputError, match=match) as caught:
            filter_.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert same(content(filter_), before)
    np.testing.assert_equal(filter_.rng.bit_generator.state, generator)


def test_no_file_a_folder_a_single_array_and_objects(target, tmp_path):
    refused(target, tmp_path / "run.npz", "does not exist")
    refused(target, tmp_path, "is damaged or cut off")
    for whole in (b"timestamp x y theta\n0 0 0 0\n", b"\x80\x04N."):
        (tmp_path / "text_or_pickle.npz").write_bytes(whole)
        refused(target, tmp_path / "text_or_pickle.npz", "is damaged or cut off")
    np.save(tmp_path / "array.npy", np.zeros(3))
    refused(target, tmp_path / "array.npy", "is damaged or cut off")
    np.savez(tmp_path / "objects.npz", header=np.array([{"version": 1}], dtype=object))
    refused(target, tmp_path / "objects.npz", "is damaged or cut off")


@pytest.mark.parametrize(
    "arrays",
    [
        {"a": np.zeros(3)},
        {"header": np.zeros(3)},
        {"header": np.array("[1]")},
        {"header": np.array(json.dumps({"version": 1, "digest": "", "rng": {}, "fingerprint": 3}))},
        {"header": np.array(json.dumps({"version": 1, "digest": "", "fingerprint": {}}))},
    ],
)
def test_archive_of_something_else(target, tmp_path, arrays):
    np.savez(tmp_path / "other.npz", **arrays)
    refused(target, tmp_path / "other.npz", "is not a checkpoint of rbpf")


def changed(file: Path, path: Path, **fields: object) -> Path:
    """A copy with other entries in the header, or `name=None` for arrays that are left out."""
    with np.load(file) as archive:
        arrays = {name: archive[name] for name in archive.files if fields.get(name, 0) is not None}
    header = json.loads(str(arrays["header"]))
    header.update({name: value for name, value in fields.items() if value is not None})
    np.savez(path, **{**arrays, "header": np.array(json.dumps(header))})
    return path


def test_another_version_and_arrays_that_are_missing_or_too_many(file, target, tmp_path):
    refused(target, changed(file, tmp_path / "new.npz", version=2), "has checkpoint version 2, this program reads")
    fewer = changed(file, tmp_path / "fewer.npz", **{"particles/state": None})
    refused(target, fewer, "does not match its digest; use an earlier checkpoint")
    with np.load(file) as archive:
        np.savez(tmp_path / "more.npz", **dict(archive), more=np.zeros(2))
    refused(target, tmp_path / "more.npz", "does not match its digest")


SUBSTATE = KalmanSubstate(SE2, np.zeros(1), np.eye(1))


def other(**options) -> Filter:
    """A filter that differs from the saved one in the options given."""
    space = options.pop("space", SE2)
    landmark_map = options.pop("conditional", None) or LandmarkMap(space)
    for part in landmark_map if isinstance(landmark_map, list) else [landmark_map]:
        if isinstance(part, LandmarkMap):
            part.register(options.pop("landmark", Point(2)))
    sensor = NamedLandmarkSensor(RangeBearing(space), Point(2))
    return Filter(OdometryMotion(space), sensor, landmark_map, n=options.pop("n", 4), **options)


@pytest.mark.parametrize(
    ("filter_", "match"),
    [
        (lambda: other(n=5), "particles = 4, this one has 5"),
        (lambda: other(space=SE3), "state size = 3, this one has 7"),
        (lambda: other(resampler=Systematic()), "resampler = EssTriggered, this one has Systematic"),
        (lambda: other(lag=5), "lag = None, this one has 5"),
        (lambda: other(conditional=LandmarkMap(SE2, evidence=True)), "evidence = False, this one has True"),
        (lambda: other(landmark=Point(3)), r"landmark kind 0 = Point \(2, 0, 1\), this one has Point \(3, 0, 1\)"),
        (lambda: other(conditional=[LandmarkMap(SE2), SUBSTATE]), "conditional = .*this one has .*KalmanSubstate"),
        (lambda: other(rng=np.random.Generator(np.random.MT19937(0))), "random generator = PCG64, this one has MT"),
    ],
)
def test_another_filter(file, filter_, match):
    refused(filter_(), file, match)


def test_landmarks_that_were_not_registered_and_more_that_were(file):
    filter_ = Filter(OdometryMotion(SE2), NamedLandmarkSensor(RangeBearing(SE2), Point(2)), LandmarkMap(SE2), n=4)
    refused(filter_, file, "landmark kind 0 = .*this one has None.*register its landmarks")
    filter_ = other()
    filter_.belief().map.register(MixturePoint(4))
    filter_.load(file)
    assert filter_.steps == 6
