"""Files that are no checkpoints, not whole, or not of this filter: one sentence, and the filter as it was."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from rbpf.core.filter import Filter
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.resampling import Systematic
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import MixturePoint, Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from tests.core.worlds import Recipe, content, drive, planar_world, same

RECIPE = Recipe(n=4)
STEPS = 6


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """A checkpoint after six steps."""
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    filter_ = RECIPE.build()
    drive(filter_, planar_world(STEPS, seed=4))
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
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
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
    assert filter_.steps == STEPS
