"""Checkpoints: one file of plain arrays, no pickle, with a digest that a damaged file cannot keep.

The file is a NumPy `.npz` archive. Its entry `header` is JSON text: format version, the filter's fingerprint (model
classes, sizes), the state of the random generator and a SHA-256 digest of all other entries.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbpf.core.archive import checked
from rbpf.core.archive import load_arrays as load_arrays
from rbpf.core.archive import save_arrays as save_arrays
from rbpf.core.genealogy import Lineage
from rbpf.core.history import History
from rbpf.core.particles import Particles
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.core.filter import Filter

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
    with _unchanged_by_failure(filter_), fitting(path):
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


@contextmanager
def _unchanged_by_failure(filter_: "Filter") -> Iterator[None]:
    """Puts a filter back as it was if it cannot be restored; what is restored takes new objects, never the old ones."""
    held = [(item, dict(vars(item))) for item in (filter_, *filter_.marginals.parts.values())]
    rng = filter_.rng.bit_generator.state
    try:
        yield
    except InputError:
        for item, attributes in held:
            vars(item).clear()
            vars(item).update(attributes)
        filter_.rng.bit_generator.state = rng
        raise


def _restore(filter_: "Filter", arrays: dict[str, np.ndarray], rng_state: dict[str, Any]) -> None:
    state = checked(arrays, "particles/state", filter_.particles.state.shape, "f")
    log_weights = checked(arrays, "particles/log_weights", (filter_.n,), "f")
    lineage = Lineage(filter_.n)
    lineage.restore(arrays)
    history = History(lineage, filter_.history.lag, filter_.history.clouds)
    history.restore(arrays)
    filter_.lineage, filter_.history = lineage, history
    filter_.marginals.begin(filter_.n, lineage)
    filter_.marginals.restore(arrays)
    filter_.particles = Particles(state.copy(), log_weights.copy())
    steps, stamp = checked(arrays, "filter/numbers", (2,), "i").tolist()
    if steps < 0:
        raise InputError(f"the array filter/numbers counts {steps} steps")
    filter_.steps, filter_.stamp_ns = steps, stamp if checked(arrays, "filter/started", (), "b") else None
    filter_.log_evidence = float(checked(arrays, "filter/log_evidence", (), "f"))
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
