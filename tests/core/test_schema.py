"""Schemas of arrays: what fits is copied as declared, all else is one sentence that names the array."""

import numpy as np
import pytest

from rbpf.core.checkpoint import elements, grey, integers, numbers, poses, read, read_one, split, text, truths
from rbpf.errors import InputError
from rbpf.lie import SE2

SCHEMA = {
    "px": numbers("features", 2),
    "member": integers("features", least=-1, below="members"),
    "pose": poses("features"),
    "patch": grey("features", 3, 3),
    "alive": truths("features"),
    "ids": integers("features", ascending=True, refers="map"),
    "log_weights": numbers("features", values="log"),
    "nis": numbers("features", values="any"),
    "words": text(),
}
SOUND = {
    "px": np.ones((2, 2)),
    "member": np.array([-1, 4]),
    "pose": np.array([[0, 0, 0, 1.0, 5, 6, 7], [0.6, 0, 0, 0.8, 1, 2, 3]]),
    "patch": np.ones((2, 3, 3), dtype=np.uint8),
    "alive": np.array([True, False]),
    "ids": np.array([3, 7], dtype=np.int32),
    "map": np.array([7, 5, 3]),
    "log_weights": np.array([0.0, -np.inf]),
    "nis": np.array([np.nan, np.inf]),
    "words": np.array("é"),
}


def test_what_fits_is_copied():
    found = read({f"a/{name}": array for name, array in SOUND.items()} | {"map": SOUND["map"]}, SCHEMA, "a/", members=5)
    assert list(found) == list(SCHEMA)
    for name, array in found.items():
        np.testing.assert_array_equal(array, SOUND[name])
        assert array.dtype.kind == "U" or (array.dtype == SCHEMA[name].dtype and array is not SOUND[name])


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("px", None, "px is missing"),
        ("px", np.ones((2, 3)), r"px must hold numbers of shape \(features = 2, 2\), got \(2, 3\) float64"),
        ("px", np.ones((2, 2), dtype=int), r"px must hold numbers"),
        ("px", np.full((2, 2), np.nan), r"px must hold finite numbers, got nan at 0, 0"),
        ("px", np.full((2, 2), -1e31), r"px must hold finite numbers"),
        ("member", np.zeros(3, dtype=int), r"member must hold whole numbers of shape \(features = 2\), got \(3,\)"),
        ("member", np.array([0, 5]), "member must hold whole numbers from -1 to 4, got 5 at 1"),
        ("member", np.array([-2, 0]), "member must hold whole numbers from -1 to 4, got -2 at 0"),
        ("ids", np.array([3, 3]), "ids must hold ascending numbers, got 3 at 1"),
        ("ids", np.array([3, 8]), "ids must hold what map holds, got 8 at 1"),
        ("ids", np.array([3, 2**63 - 1]), "ids must hold whole numbers"),
        ("pose", np.zeros((2, 7)), "pose must hold poses"),
        ("pose", np.full((2, 7), 0.5) * [2, 2, 2, 2, 1, 1, 1], "pose must hold poses"),
        ("patch", np.ones((2, 3, 3)), "patch must hold whole numbers of shape"),
        ("alive", np.ones(2, dtype=int), "alive must hold truth values"),
        ("log_weights", np.array([0.0, np.nan]), "log_weights must hold finite numbers, got nan at 1"),
        ("words", np.array(3), "words must hold text"),
    ],
)
def test_what_does_not_fit(name, array, words):
    arrays = {key: value for key, value in (SOUND | {name: array}).items() if value is not None}
    with pytest.raises(InputError, match=words) as caught:
        read(arrays, SCHEMA, members=5)
    assert "\n" not in str(caught.value)


def test_elements_of_a_group_and_rows():
    assert read_one({"x": np.zeros((4, 3))}, "x", elements(SE2, "n"), n=4).shape == (4, 3)
    with pytest.raises(InputError, match=r"x must hold numbers of shape \(n = 5, 3\)"):
        read_one({"x": np.zeros((4, 3))}, "x", elements(SE2, "n"), n=5)
    assert [len(part) for part in split(np.zeros((5, 2)), [2, 0, 3], "x")] == [2, 0, 3]
    with pytest.raises(InputError, match="x has 5 rows, expected 4"):
        split(np.zeros((5, 2)), [2, 2], "x")
