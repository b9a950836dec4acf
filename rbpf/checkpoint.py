"""Checkpoints: one file of plain arrays, no pickle, with a digest that a damaged file cannot keep.

The file is a NumPy `.npz` archive. Its entry `header` is JSON text: format version, the filter's fingerprint (model
classes, sizes), the state of the random generator and a SHA-256 digest of all other entries.
"""

import hashlib
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbpf.errors import InputError
from rbpf.genealogy import Lineage
from rbpf.history import History
from rbpf.particles import Particles

if TYPE_CHECKING:
    from rbpf.filter import Filter

VERSION = 1


def write_checkpoint(filter_: "Filter", path: Path, extra: dict[str, np.ndarray]) -> None:
    """Saves a filter; the file appears under its name only when it is complete."""
    arrays = {
        "particles/state": filter_.particles.state,
        "particles/log_weights": filter_.particles.log_weights,
        "filter/numbers": np.array([filter_.steps, -1 if filter_.stamp_ns is None else filter_.stamp_ns]),
        "filter/started": np.array(filter_.stamp_ns is not None),
        "filter/log_evidence": np.array(filter_.log_evidence),
        **filter_.lineage.arrays(),
        **filter_.history.arrays(),
        **filter_.marginals.arrays(),
        **{f"extra/{name}": array for name, array in extra.items()},
    }
    header = {
        "version": VERSION,
        "fingerprint": fingerprint(filter_),
        "rng": _jsonable(filter_.rng.bit_generator.state),
        "digest": _digest(arrays),
    }
    save_arrays(path, {"header": np.array(json.dumps(header)), **arrays})


def read_checkpoint(filter_: "Filter", path: Path) -> dict[str, np.ndarray]:
    """Restores a filter built with the same models and returns the extra arrays; a bad file changes nothing.

    Raises:
        InputError: the file is missing, damaged, of another version or of another filter.
    """
    arrays = load_arrays(path)
    try:
        header = json.loads(str(arrays.pop("header")))
        version, digest, rng = header["version"], header["digest"], header["rng"]
        expected = dict(header["fingerprint"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not a checkpoint of rbpf: its header is missing or unreadable"
        ) from error
    if version != VERSION:
        raise InputError(f"{path} has checkpoint version {version}, this program reads version {VERSION}")
    if digest != _digest(arrays):
        raise InputError(
            f"{path} is damaged: its content does not match its digest; use an earlier checkpoint"
        )
    found = fingerprint(filter_)
    for name, value in expected.items():
        if found.get(name) != value:
            raise InputError(
                f"{path} belongs to a filter with {name} = {value}, this one has {found.get(name)}: "
                "build the filter with the options of the saved run, and register its landmarks"
            )
    _restore(filter_, arrays, rng)
    return {name.removeprefix("extra/"): array for name, array in arrays.items() if name.startswith("extra/")}


def fingerprint(filter_: "Filter") -> dict[str, Any]:
    """What must agree between the filter that saved and the one that loads."""
    return {
        "particles": filter_.n,
        "motion": type(filter_.motion).__name__,
        "state size": filter_.space.size,
        "proposal": type(filter_.proposal).__name__,
        "resampler": type(filter_.resampler).__name__,
        "conditional": [type(part).__name__ for part in filter_.marginals.parts.values()],
        "lag": filter_.history.lag,
        "clouds": filter_.history.clouds,
        **filter_.marginals.options(),
        "random generator": type(filter_.rng.bit_generator).__name__,
    }


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes an `.npz` under a temporary name, then renames it.

    Raises:
        InputError: the place cannot be written to, or an array holds Python objects.
    """
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        os.replace(temporary, path)
    except (OSError, ValueError) as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written: {error}") from error


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads every array of an `.npz`.

    Raises:
        InputError: the file is missing, cut off or not an archive of plain arrays.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist") from error
    except (
        OSError,
        ValueError,
        EOFError,
        KeyError,
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,
        AttributeError,
        TypeError,
        RuntimeError,
        MemoryError,
        SyntaxError,
        OverflowError,
    ) as error:
        raise InputError(f"{path} is damaged or cut off: it is not a complete archive of arrays") from error


def _restore(filter_: "Filter", arrays: dict[str, np.ndarray], rng_state: dict[str, Any]) -> None:
    lineage = Lineage(filter_.n)
    lineage.restore(arrays)
    history = History(lineage, filter_.history.lag, filter_.history.clouds)
    history.restore(arrays)
    filter_.lineage, filter_.history = lineage, history
    filter_.marginals.begin(filter_.n, lineage)
    filter_.marginals.restore(arrays)
    filter_.particles = Particles(arrays["particles/state"].copy(), arrays["particles/log_weights"].copy())
    steps, stamp = (int(value) for value in arrays["filter/numbers"])
    filter_.steps, filter_.stamp_ns = steps, stamp if arrays["filter/started"] else None
    filter_.log_evidence = float(arrays["filter/log_evidence"])
    filter_.rng.bit_generator.state = rng_state


def _digest(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _jsonable(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return int(value) if isinstance(value, np.integer) else value
