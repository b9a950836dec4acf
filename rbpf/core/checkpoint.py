"""Files of named plain arrays; checkpoints, which add a header and a digest; and schemas for the arrays of a file.

A file is a NumPy `.npz` archive without pickled objects, and no header is trusted: the size that it claims is checked
against the file's own size before anything is allocated. Members are stored uncompressed, so that no file can expand beyond
its size. A checkpoint's entry `header` is JSON text: format version, the filter's fingerprint (model classes, sizes), the
state of the random generator and a SHA-256 digest of all other entries.
"""

import hashlib
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Any, ClassVar, Literal

import numpy as np

from rbpf import gaussian
from rbpf.errors import InputError
from rbpf.lie import SE3, LieGroup

VERSION = 1  #: Version of the checkpoint format.

#: Exceptions of zipfile and NumPy on a truncated, damaged or malicious file.
UNREADABLE = (
    OSError, ValueError, LookupError, ArithmeticError, AttributeError, TypeError, RuntimeError, EOFError, MemoryError,
    SyntaxError, TokenError, zipfile.BadZipFile,
)  # fmt: skip
NOT_PLAIN = "it must hold truth values, numbers or text"
_PLAIN = re.compile(r"[<>|][biufU]\d{1,9}")  #: Accepted array types: booleans, numbers, text.


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an `.npz` atomically. Raises InputError: the path is not writable, the disk is full, or an array is not plain."""
    for name, array in arrays.items():
        try:
            _require_plain(np.asarray(array))
        except ValueError as error:
            raise InputError(f"{path} cannot be written: the array {name}: {error}") from error
        if "\0" in name:
            raise InputError(f"{path} cannot be written: the name {name!r} of an array holds a zero")
    # All are plain by now; NumPy below 2.2 would store `allow_pickle` as an array. Its types take no dict of arrays.
    plain: dict[str, Any] = dict(arrays)
    with whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **plain)
        file.flush()
        # Without fsync a power cut after the renaming could lose both the old and the new file.
        os.fsync(file.fileno())


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary path beside a file, renamed to the file once everything is written.

    On failure the temporary file is removed and an existing file is unchanged. Whatever has the temporary name before, even
    a link, is removed. Raises InputError: the path is not writable, or the disk is full.
    """
    temporary = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        temporary.unlink(missing_ok=True)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        reason = (error.strerror or str(error)).strip().splitlines()[0]
        raise InputError(f"{path} cannot be written: {reason}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def load_arrays(path: Path, only: str | None = None) -> dict[str, np.ndarray]:
    """Reads all arrays of an `.npz` that `save_arrays` wrote, or just the one named `only`, if present; all writable.

    Raises InputError: the file is missing, truncated or not an archive of plain arrays.
    """
    try:
        if not os.path.isfile(path) and os.path.exists(path):
            raise ValueError("a pipe would be waited for, a device read without end")
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if sum(info.file_size for info in members) > os.fstat(file.fileno()).st_size:
                raise ValueError("the members are larger than the file")
            named = {info.filename.removesuffix(".npy"): info for info in members}
            wanted = named if only is None else {only} & named.keys()
            return {name: _array(archive, named[name]) for name in wanted}
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist") from error
    except UNREADABLE as error:
        raise InputError(f"{path} is damaged or cut off: it is not a complete archive of arrays") from error


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Wraps the reading of a checkpoint's arrays: any error becomes one InputError that they do not fit together."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path} cannot be used: {error}") from error
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, AssertionError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError(
            f"{path} is damaged: its arrays do not fit together ({reason}); use an earlier checkpoint"
        ) from error


def write_checkpoint(
    path: Path, arrays: dict[str, np.ndarray], fingerprint: Mapping[str, object], rng_state: Mapping[str, object]
) -> None:
    """Saves arrays with a fingerprint: plain named values that must agree between saving and loading."""
    header = {"version": VERSION, "fingerprint": fingerprint, "rng": rng_state, "digest": _digest(arrays)}
    save_arrays(path, {"header": np.array(json.dumps(header, default=lambda value: value.tolist())), **arrays})


def read_checkpoint(path: Path, fingerprint: Mapping[str, object]) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Arrays and random generator state. Raises InputError: the file is missing, damaged, of another version or filter."""
    arrays = load_arrays(path)
    try:
        header = json.loads(str(arrays.pop("header")))
        version, digest, rng_state = header["version"], header["digest"], header["rng"]
        expected = dict(header["fingerprint"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a checkpoint of rbpf: its header is missing or unreadable") from error
    if version != VERSION:
        raise InputError(f"{path} has checkpoint version {version}, this program reads version {VERSION}")
    if digest != _digest(arrays):
        raise InputError(f"{path} is damaged: its content does not match its digest; use an earlier checkpoint")
    for name, value in expected.items():
        if fingerprint.get(name) != value:
            raise InputError(
                f"{path} belongs to a filter with {name} = {value}, this one has {fingerprint.get(name)}: "
                "build the filter with the options of the saved run, and register its landmarks"
            )
    return arrays, rng_state


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """One member; all errors are of the types that `load_arrays` handles."""
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
        raise ValueError("a member is compressed or encrypted")
    member = BytesIO(archive.read(info))
    # The header: type and shape. NumPy writes plain arrays in version 1 of its format.
    if np.lib.format.read_magic(member) != (1, 0):
        raise ValueError("a member is no plain array")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(member)
    if not _PLAIN.fullmatch(dtype.str):
        raise ValueError(NOT_PLAIN)
    data = member.read()
    if math.prod(shape) * max(dtype.itemsize, 1) != len(data) or min(shape, default=0) < 0:
        raise ValueError("a member has another size than its header claims")
    # The data: bit patterns that are not a boolean or a character are refused.
    flat = np.frombuffer(data, dtype)
    _require_plain(flat)
    return flat.reshape(shape, order="F" if is_fortran else "C").copy(order="K")


def _require_plain(array: np.ndarray) -> None:
    """Raises ValueError: the array is not of a type that these files hold."""
    dtype = array.dtype
    if not _PLAIN.fullmatch(dtype.str) or dtype.kind not in "biufU":
        raise ValueError(f"{NOT_PLAIN}, it is of {dtype}")
    flat = np.ravel(array)
    if dtype.kind == "b" and flat.size and flat.view(np.uint8).max() > 1:
        raise ValueError("a truth value is none")
    if dtype.kind == "U" and flat.size and dtype.itemsize:
        codes = flat.view(dtype.byteorder.replace("|", "=") + "u4")
        if codes.max() > 0x10FFFF or ((codes >= 0xD800) & (codes < 0xE000)).any():
            raise ValueError("a text holds what is no character")


def _digest(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


# Schemas of the arrays of a file: declared once per state, checked before any index or size is used.
#
#     FEATURES = {"px": numbers("features", 2), "member": integers("features", least=-1, below="members")}
#     found = read(arrays, FEATURES, "features/", members=5)
#
# A named size is equal wherever the name occurs: it is set by the caller, or by the first array that has it.

BEYOND = 2**62  #: Whole numbers, as names and stamps, lie between minus this and this.
LARGEST = 1e30  #: Largest accepted number, so that squares stay finite.

_WORDS = {"f": "numbers", "i": "whole numbers", "u": "whole numbers", "b": "truth values", "U": "text"}
_CLOSE = 1e-6  #: Tolerance of the unit length of quaternions.


@dataclass(frozen=True)
class Entry:
    """Requirements of one array."""

    dtype: type  #: type it is converted to.
    shape: tuple[int | str, ...]  #: sizes or names of sizes; "" for any size.
    least: float | None = None  #: its lowest value.
    below: int | str | None = None  #: exclusive upper bound; a number, or the name of a size.
    values: Literal["finite", "log", "any"] = "finite"  #: "finite"; "log" also takes −∞; "any" also +∞ and NaN.
    space: LieGroup | None = None  #: group whose elements the last axis holds; None for plain numbers.
    ascending: bool = False  #: strictly ascending values.
    ordered: bool = False  #: non-decreasing values, such as times.
    distinct: bool = False  #: distinct values, such as names.
    covariance: bool = False  #: the last two axes hold covariances, which may be singular.
    refers: str | None = None  #: name of an array in the same file that must contain all its values.

    def empty(self, **sizes: int) -> np.ndarray:
        shape = [sizes[size] if isinstance(size, str) else size for size in self.shape[1:]]
        return np.zeros((0, *shape), self.dtype)


Schema = Mapping[str, Entry]


def entry(*shape: int | str, **options: Any) -> Entry:
    """An `Entry` of this shape."""
    return Entry(shape=shape, **options)


#: Entries by type: numbers, integers, booleans, text, grey levels of images.
numbers, integers = partial(entry, dtype=np.float64), partial(entry, dtype=np.int64)
truths, text, grey = (partial(entry, dtype=kind) for kind in (np.bool_, np.str_, np.uint8))


#: Times, and covariances, whose shape includes both axes.
stamps, covariances = partial(integers, ordered=True), partial(numbers, covariance=True)


def elements(space: LieGroup, *shape: int | str) -> Entry:
    """Elements (…, E) of a group."""
    return Entry(np.float64, (*shape, space.size), space=space)


def poses(*shape: int | str) -> Entry:
    """Elements (…, 7) of SE(3)."""
    return elements(SE3, *shape)


def read(arrays: Mapping[str, np.ndarray], schema: Schema, prefix: str = "", **sizes: int) -> dict[str, np.ndarray]:
    """Validated copies of a schema's arrays, of the schema's types, by their names without the prefix.

    Args:
        arrays: named arrays of a file.
        schema: their requirements; named sizes are set in this order.
        prefix: of their names in the file.
        sizes: named sizes that are known.

    Raises InputError: one is missing, or does not meet its requirements.
    """
    sizes = dict(sizes)
    return {name: _read(arrays, prefix + name, entry, sizes) for name, entry in schema.items()}


def read_one(arrays: Mapping[str, np.ndarray], name: str, entry: Entry, **sizes: int) -> np.ndarray:
    """One array; errors as of `read`."""
    return _read(arrays, name, entry, sizes)


class Kept:
    """Base class that saves the attributes in `kept` to a checkpoint, named by `prefix` and without leading underscore."""

    kept: ClassVar[Schema]
    prefix: ClassVar[str]

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        return {self.prefix + name.lstrip("_"): np.asarray(getattr(self, name)) for name in self.kept}

    def restore(self, arrays: Mapping[str, np.ndarray], **sizes: int) -> None:
        """The inverse of `arrays`, given known sizes; errors as of `read`."""
        found = read(arrays, {name.lstrip("_"): entry for name, entry in self.kept.items()}, self.prefix, **sizes)
        for name, array in zip(self.kept, found.values(), strict=True):
            setattr(self, name, array if array.ndim else array.item())


def require(what: str, values: Mapping[str, Any], schema: Schema, **sizes: int) -> None:
    """Validates arrays in memory against a schema; `what` names them in messages; errors as of `read`."""
    for name in schema:
        if not isinstance(values[name], np.ndarray):
            raise InputError(f"{what}: {name} must be an array, got a {type(values[name]).__name__}")
    try:
        read(values, schema, "", **sizes)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None


def taken(what: str, values: Mapping[str, Any], schema: Schema) -> dict[str, np.ndarray]:
    """Arrays from what a user gives, lists or numbers of another type with the same values; errors as of `require`."""
    arrays = dict[str, np.ndarray]()
    for name, entry in schema.items():
        try:
            array = np.asarray(values[name])
        except ValueError as error:
            raise InputError(f"{what}: {name} must be an array, got lists of different lengths") from error
        array = entry.empty() if array.shape == (0,) else array
        with np.errstate(invalid="ignore"):
            alike = array.dtype.kind in "biuf" and bool((array.astype(entry.dtype) == array).all())
        arrays[name] = array.astype(entry.dtype, copy=False) if alike else array
    require(what, arrays, schema)
    return arrays


def split(rows: np.ndarray, counts: Sequence[int], name: str) -> list[np.ndarray]:
    """Splits the rows of an array by `counts`. Raises InputError: the number of rows differs."""
    if sum(counts) != len(rows):
        raise InputError(f"the array {name} has {len(rows)} rows, expected {sum(counts)}")
    return np.split(rows, np.cumsum(counts)[:-1]) if len(counts) else []


def _read(arrays: Mapping[str, np.ndarray], name: str, entry: Entry, sizes: dict[str, int]) -> np.ndarray:
    array = arrays.get(name)
    if array is None:
        raise InputError(f"the array {name} is missing")
    # Type and shape; the first occurrence of a named size sets it.
    wanted = np.dtype(entry.dtype)
    kinds = {"i": "iu", "f": "fiub" if entry.values == "any" else "f"}.get(wanted.kind, wanted.kind)
    fits = array.dtype.kind in kinds and array.ndim == len(entry.shape)
    if fits:
        for size, expected in zip(array.shape, entry.shape, strict=True):
            if isinstance(expected, str) and expected:
                expected = sizes.setdefault(expected, size)
            fits = fits and expected in ("", size)
    if not fits:
        shape = ", ".join(f"{size} = {sizes[size]}" if size in sizes else str(size) or "any" for size in entry.shape)
        raise InputError(
            f"the array {name} must hold {_WORDS[wanted.kind]} of shape ({shape}), got {array.shape} {array.dtype}"
        )
    if wanted.kind == "f" and entry.values != "any":
        is_right = np.abs(array) <= LARGEST
        if entry.values == "log":
            is_right |= np.isneginf(array)
        _require(is_right, array, name, "finite numbers")
    # Indices, counts, ranges.
    below = sizes[entry.below] if isinstance(entry.below, str) else entry.below
    if wanted.kind == "i":
        least = -BEYOND if entry.least is None else entry.least
        below = BEYOND if below is None else below
        _require((array >= least) & (array < below), array, name, f"whole numbers from {least} to {below - 1}")
    elif entry.least is not None:
        _require(array >= entry.least, array, name, f"numbers of at least {entry.least:g}")
    if entry.ascending:
        _require(np.diff(array, prepend=array[:1] - 1) > 0, array, name, "ascending numbers")
    if entry.ordered:
        _require(np.diff(array, prepend=array[:1]) >= 0, array, name, "numbers in order (sort what they are of)")
    if entry.distinct:
        is_first = np.isin(np.arange(array.size), np.unique(array, return_index=True)[1])
        _require(is_first, array, name, "distinct numbers (keep one of each)")
    if entry.covariance:
        try:
            gaussian.psd_factor(array)
        except InputError as error:
            raise InputError(f"the array {name} must hold covariances: {error}") from error
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
    """Raises InputError with the first row for which `is_right` is False."""
    if not np.all(is_right):
        row = tuple(int(i) for i in np.argwhere(~np.asarray(is_right))[0])
        where = f" at {', '.join(map(str, row))}" if row else ""
        raise InputError(f"the array {name} must hold {words}, got {array[row].tolist()}{where}")
