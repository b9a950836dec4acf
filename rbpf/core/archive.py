"""Files of named plain arrays: NumPy's `.npz`, never pickled, and read without trusting a header.

What a header claims is compared with the file's own size before anything is allocated: members are stored as they are,
uncompressed, so that no file unfolds into more than itself.
"""

import ast
import math
import os
import re
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from rbpf.errors import InputError

LONGEST_HEADER = 1 << 16
"""Bytes of an array's header; NumPy's own are of about a hundred."""

_MAGIC = b"\x93NUMPY"
_PLAIN = re.compile(r"[<>|][biufU]\d{1,9}")
"""Types of arrays that are read: truth values, numbers, text."""


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an `.npz` under a temporary name, then renames it.

    Raises:
        InputError: the place cannot be written to or is full, or an array holds Python objects.
    """
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
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


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads every array of an `.npz` that `save_arrays` wrote; they may be written to.

    Raises:
        InputError: the file is missing, cut off or not an archive of plain arrays.
    """
    try:
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if sum(info.file_size for info in members) > os.fstat(file.fileno()).st_size:
                raise ValueError("the members are larger than the file")
            return {info.filename.removesuffix(".npy"): _array(archive, info) for info in members}
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


def checked(
    arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...], kinds: str
) -> np.ndarray:
    """One of the arrays of a file.

    Args:
        arrays: of the file.
        name: of the array.
        shape: that it must have; None where any size will do.
        kinds: letters of the types that it may have, as `dtype.kind` gives them.

    Raises:
        InputError: it is missing, or is not as expected.
    """
    array = arrays.get(name)
    if array is None:
        raise InputError(f"the array {name} is missing")
    fits = len(array.shape) == len(shape) and all(
        wanted is None or size == wanted for size, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kinds:
        raise InputError(f"the array {name} must be {shape} of kind {kinds}, got {array.shape} {array.dtype}")
    return array


def within(
    arrays: Mapping[str, np.ndarray], name: str, size: int | None, least: int, stop: int
) -> np.ndarray:
    """One of the arrays of a file: whole numbers (size,) from `least` to before `stop`.

    Raises:
        InputError: it is missing, or is not as expected.
    """
    array = checked(arrays, name, (size,), "i")
    if array.size and not least <= array.min() <= array.max() < stop:
        raise InputError(f"the array {name} must hold numbers from {least} to {stop - 1}")
    return array.astype(np.int64)


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """One member; whatever is wrong with it raises an error that `load_arrays` knows."""
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
        raise ValueError("a member is compressed or encrypted")
    data = archive.read(info)
    start, dtype, is_fortran, shape = _header(data)
    if math.prod(shape) * max(dtype.itemsize, 1) != len(data) - start or min(shape, default=0) < 0:
        raise ValueError("a member has another size than its header claims")
    flat = np.frombuffer(data, dtype, offset=start)
    _require_values(flat)
    return flat.reshape(shape, order="F" if is_fortran else "C").copy(order="K")


def _header(data: bytes) -> tuple[int, np.dtype, bool, tuple[int, ...]]:
    """Where the numbers begin, and what they are: the `.npy` format, versions 1 to 3."""
    if data[:6] != _MAGIC or data[6:8] not in (b"\x01\x00", b"\x02\x00", b"\x03\x00"):
        raise ValueError("a member is no array")
    first = 10 if data[6] == 1 else 12
    start = first + int.from_bytes(data[8:first], "little")
    if start > min(len(data), LONGEST_HEADER):
        raise ValueError("a member's header is longer than it can be")
    entries = ast.literal_eval(data[first:start].decode("latin1").strip())
    descr, is_fortran, shape = (entries[name] for name in ("descr", "fortran_order", "shape"))
    if not (isinstance(descr, str) and _PLAIN.fullmatch(descr) and isinstance(shape, tuple)):
        raise ValueError("a member holds something else than plain numbers or text")
    if not all(type(size) is int for size in shape):
        raise ValueError("a member's shape is none")
    return start, np.dtype(descr), bool(is_fortran), shape


def _require_values(flat: np.ndarray) -> None:
    """Refuses bit patterns that are no truth value or no text."""
    if flat.dtype.kind == "b" and flat.size and flat.view(np.uint8).max() > 1:
        raise ValueError("a truth value is none")
    if flat.dtype.kind == "U" and flat.size and flat.dtype.itemsize:
        codes = flat.view(flat.dtype.byteorder.replace("|", "=") + "u4")
        if codes.max() > 0x10FFFF or ((codes >= 0xD800) & (codes < 0xE000)).any():
            raise ValueError("a text holds what is no character")
