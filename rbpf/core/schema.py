"""What the arrays of a file must be: declared once for each state, and checked before anything follows an index or a size.

    FEATURES = {"px": numbers("features", 2), "member": integers("features", least=-1, below="members")}
    found = read(arrays, FEATURES, "features/", members=5)

A size that has a name is the same wherever the name comes: the first array that has it says what it is, or the caller.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, LieGroup

LARGEST = 1e30
"""No number is larger, so that squares stay finite."""

_WORDS = {"f": "numbers", "i": "whole numbers", "u": "whole numbers", "b": "truth values", "U": "text"}
_CLOSE = 1e-6
"""Quaternions of poses are of unit length up to this."""


@dataclass(frozen=True)
class Entry:
    """What one array must be.

    Attributes:
        dtype: that it is read as.
        shape: sizes, or names of sizes; "" for any.
        least: its lowest value.
        below: above its highest value; a number, or the name of a size.
        values: "finite"; "log" also takes −∞; "any" also +∞ and NaN.
        space: group whose elements the last axis holds; None for plain numbers.
        ascending: each value is above the one before.
        refers: name of an array of the same file that holds all of its values.
    """

    dtype: type
    shape: tuple[int | str, ...]
    least: float | None = None
    below: int | str | None = None
    values: Literal["finite", "log", "any"] = "finite"
    space: LieGroup | None = None
    ascending: bool = False
    refers: str | None = None

    def empty(self, **sizes: int) -> np.ndarray:
        """An array without rows."""
        shape = [sizes[size] if isinstance(size, str) else size for size in self.shape[1:]]
        return np.zeros((0, *shape), self.dtype)


Schema = Mapping[str, Entry]


def numbers(*shape: int | str, **options: Any) -> Entry:
    """Floating-point numbers, see `Entry`."""
    return Entry(**{"dtype": np.float64, "shape": shape, **options})


def integers(*shape: int | str, **options: Any) -> Entry:
    """Whole numbers, see `Entry`."""
    return Entry(**{"dtype": np.int64, "shape": shape, **options})


def truths(*shape: int | str) -> Entry:
    """Truth values."""
    return Entry(np.bool_, shape)


def grey(*shape: int | str) -> Entry:
    """Grey levels of images."""
    return Entry(np.uint8, shape)


def elements(space: LieGroup, *shape: int | str) -> Entry:
    """Elements (…, E) of a group."""
    return Entry(np.float64, (*shape, space.size), space=space)


def poses(*shape: int | str) -> Entry:
    """Elements (…, 7) of SE(3)."""
    return elements(SE3, *shape)


def text(*shape: int | str) -> Entry:
    """Text."""
    return Entry(np.str_, shape)


def read(arrays: Mapping[str, np.ndarray], schema: Schema, prefix: str = "", **sizes: int) -> dict[str, np.ndarray]:
    """The arrays of a schema, without the prefix of their names; copies, of the schema's types.

    Args:
        arrays: of a file.
        schema: what they must be; in this order sizes get their names.
        prefix: of their names in the file.
        sizes: that are known beforehand.

    Raises:
        InputError: one is missing, or is not what it should be.
    """
    sizes = dict(sizes)
    return {name: _read(arrays, prefix + name, entry, sizes) for name, entry in schema.items()}


def read_one(arrays: Mapping[str, np.ndarray], name: str, entry: Entry, **sizes: int) -> np.ndarray:
    """One array; errors as `read`."""
    return _read(arrays, name, entry, sizes)


def split(rows: np.ndarray, counts: Sequence[int], name: str) -> list[np.ndarray]:
    """The rows of an array as so many each.

    Raises:
        InputError: there are not as many rows.
    """
    if sum(counts) != len(rows):
        raise InputError(f"the array {name} has {len(rows)} rows, expected {sum(counts)}")
    return np.split(rows, np.cumsum(counts)[:-1]) if len(counts) else []


def _read(arrays: Mapping[str, np.ndarray], name: str, entry: Entry, sizes: dict[str, int]) -> np.ndarray:
    array = arrays.get(name)
    if array is None:
        raise InputError(f"the array {name} is missing")
    # Type and shape; a size that is named for the first time is what it is here.
    wanted = np.dtype(entry.dtype)
    kinds = {"i": "iu", "f": "fiub" if entry.values == "any" else "f"}.get(wanted.kind, wanted.kind)
    fits = array.dtype.kind in kinds and array.ndim == len(entry.shape)
    if fits:
        for size, expected in zip(array.shape, entry.shape, strict=True):
            if isinstance(expected, str) and expected:
                expected = sizes.setdefault(expected, size)
            fits = fits and expected in ("", size)
    if not fits:
        shape = ", ".join(_sized(expected, sizes) for expected in entry.shape)
        raise InputError(
            f"the array {name} must hold {_WORDS[wanted.kind]} of shape ({shape}), got {array.shape} {array.dtype}"
        )
    if wanted.kind == "f" and entry.values != "any":
        is_right = np.abs(array) <= LARGEST
        if entry.values == "log":
            is_right |= np.isneginf(array)
        _require(is_right, array, name, "finite numbers")
    # What is followed: indices, counts, ranges.
    below = sizes[entry.below] if isinstance(entry.below, str) else entry.below
    if wanted.kind == "i":
        least = -(2**62) if entry.least is None else entry.least
        below = 2**62 if below is None else below
        _require((array >= least) & (array < below), array, name, f"whole numbers from {least} to {below - 1}")
    elif entry.least is not None:
        _require(array >= entry.least, array, name, f"numbers of at least {entry.least:g}")
    if entry.ascending:
        _require(np.diff(array, prepend=array[:1] - 1) > 0, array, name, "ascending numbers")
    if entry.refers is not None:
        held = np.isin(array, arrays.get(entry.refers, array[:0]))
        _require(held, array, name, f"what {entry.refers} holds")
    space = entry.space
    if space is not None and space.size > space.dim:
        with np.errstate(all="ignore"):
            off = np.abs(space.normalise(array) - array)
        _require(off <= _CLOSE, array, name, "poses, of unit quaternions")
    return array.astype(wanted) if wanted.kind != "U" else array


def _require(is_right: np.ndarray, array: np.ndarray, name: str, words: str) -> None:
    """Refuses an array whose rows are not all right, with the first that is not."""
    if not np.all(is_right):
        row = tuple(int(i) for i in np.argwhere(~np.asarray(is_right))[0])
        where = f" at {', '.join(map(str, row))}" if row else ""
        raise InputError(f"the array {name} must hold {words}, got {array[row].tolist()}{where}")


def _sized(expected: int | str, sizes: Mapping[str, int]) -> str:
    if isinstance(expected, int):
        return str(expected)
    return f"{expected} = {sizes[expected]}" if expected in sizes else expected or "any"
