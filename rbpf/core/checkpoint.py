"""Files of named plain arrays, and checkpoints: arrays with a header and a digest that a damaged file cannot keep.

A file is a NumPy `.npz` archive, never pickled, and read without trusting a header. What a header claims is compared with
the file's own size before anything is allocated: members are stored as they are, uncompressed, so that no file unfolds into
more than itself. A checkpoint's entry `header` is JSON text: format version, the filter's fingerprint (model classes, sizes),
the state of the random generator and a SHA-256 digest of all other entries.
"""

import ast
import hashlib
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from rbpf.errors import InputError

VERSION = 1
"""Of the format of checkpoints."""

LONGEST_HEADER = 1 << 16
"""Bytes of an array's header; NumPy's own are of about a hundred."""

_MAGIC = b"\x93NUMPY"
NOT_PLAIN = "it must hold truth values, numbers or text"
_PLAIN = re.compile(r"[<>|][biufU]\d{1,9}")
"""Types of arrays that are read: truth values, numbers, text."""


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an `.npz` under a temporary name, then renames it.

    Raises:
        InputError: the place cannot be written to or is full, or an array is none that `load_arrays` reads.
    """
    for name, array in arrays.items():
        try:
            _require_plain(np.asarray(array))
        except ValueError as error:
            raise InputError(f"{path} cannot be written: the array {name}: {error}") from error
        if "\0" in name:
            raise InputError(f"{path} cannot be written: the name {name!r} of an array holds a zero")
    temporary = path.with_name(path.name + ".partial")
    try:
        with open_new(temporary) as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            # Else a power cut after the renaming could leave neither the old file nor the new one.
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, ValueError) as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"{path} cannot be written: {reason}") from error


def open_new(path: Path) -> BinaryIO:
    """A file that was not there before, to be written: what bears the name, a link to another file too, is removed.

    Raises:
        OSError: the place cannot be written to.
    """
    path.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "wb")


def load_arrays(path: Path, only: str | None = None) -> dict[str, np.ndarray]:
    """Reads every array of an `.npz` that `save_arrays` wrote; they may be written to.

    Args:
        path: of the file.
        only: name of the one array to read; the result is empty where there is none of this name.

    Raises:
        InputError: the file is missing, cut off or not an archive of plain arrays.
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
    except (
        OSError,
        ValueError,
        EOFError,
        KeyError,
        zipfile.BadZipFile,
        NotImplementedError,
        AttributeError,
        TypeError,
        RuntimeError,
        MemoryError,
        SyntaxError,
        OverflowError,
    ) as error:
        raise InputError(f"{path} is damaged or cut off: it is not a complete archive of arrays") from error


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Around the reading of a checkpoint's arrays: those that do not fit together make one clear sentence.

    Raises:
        InputError: an array is missing, or is not what it should be.
    """
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
    """Saves arrays with what they belong to; the file appears under its name only when it is complete.

    Args:
        path: of the file.
        arrays: by name.
        fingerprint: what must agree between who saves and who loads; plain values by name.
        rng_state: of the random generator.

    Raises:
        InputError: see `save_arrays`.
    """
    header = {"version": VERSION, "fingerprint": fingerprint, "rng": _jsonable(rng_state), "digest": _digest(arrays)}
    save_arrays(path, {"header": np.array(json.dumps(header)), **arrays})


def read_checkpoint(path: Path, fingerprint: Mapping[str, object]) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """The arrays of a checkpoint, and the state of the random generator.

    Raises:
        InputError: the file is missing, damaged, of another version or of another filter.
    """
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
    """One member; whatever is wrong with it raises an error that `load_arrays` knows."""
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
        raise ValueError("a member is compressed or encrypted")
    data = archive.read(info)
    # The header, in the `.npy` format, versions 1 to 3: where the numbers begin, and what they are.
    if data[:6] != _MAGIC or data[6:8] not in (b"\x01\x00", b"\x02\x00", b"\x03\x00"):
        raise ValueError("a member is no array")
    first = 10 if data[6] == 1 else 12
    start = first + int.from_bytes(data[8:first], "little")
    if start > min(len(data), LONGEST_HEADER):
        raise ValueError("a member's header is longer than it can be")
    entries = ast.literal_eval(data[first:start].decode("latin1").strip())
    descr, is_fortran, shape = (entries[name] for name in ("descr", "fortran_order", "shape"))
    if not (isinstance(descr, str) and _PLAIN.fullmatch(descr) and isinstance(shape, tuple)):
        raise ValueError(NOT_PLAIN)
    if not all(type(size) is int for size in shape):
        raise ValueError("a member's shape is none")
    dtype = np.dtype(descr)
    if math.prod(shape) * max(dtype.itemsize, 1) != len(data) - start or min(shape, default=0) < 0:
        raise ValueError("a member has another size than its header claims")
    # The numbers: no bit pattern that is no truth value or no text.
    flat = np.frombuffer(data, dtype, offset=start)
    _require_plain(flat)
    return flat.reshape(shape, order="F" if is_fortran else "C").copy(order="K")


def _require_plain(array: np.ndarray) -> None:
    """Raises a ValueError unless it is an array that files of this module hold."""
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


def _jsonable(value: object) -> object:
    if isinstance(value, dict):
        return {name: _jsonable(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return int(value) if isinstance(value, np.integer) else value
