"""Resumes runs from checkpoints of which one array is damaged and the digest right; see `test_damaged_checkpoints`.

A program of its own, since what compiled code does with a wrong index may end the process. Each case is told before it is
tried, and what came of it after.
"""

import json
import sys
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.core.checkpoint import _digest, load_arrays, save_arrays
from rbpf.errors import InputError
from rbpf.runs.run import Run
from tests.systems.test_contract import RESUMED, Case


@dataclass
class Listed:
    """A recording."""

    name: str = "listed"

    def frames(self, start: int = 0) -> Iterator[object]:
        raise NotImplementedError


CASES = {
    name: RESUMED[name]
    for name in (
        "known points", "nothing known", "named", "named, nothing known", "pairs", "named pairs", "robot, own maps",
        "robot, unnamed", "robot, joint map",
    )
}  # fmt: skip


def damages(array: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray | None]]:
    """Other arrays in its place, by a name; None for none."""
    yield "missing", None
    yield "one axis more", array[..., None]
    yield "no rows", array[:0] if array.ndim else np.zeros(0, array.dtype)
    yield "text", np.full(array.shape, "x")
    if array.ndim and len(array):
        yield "a row less", array[:-1]
        yield "a row twice", np.concatenate([array, array[-1:]])
        yield "backwards", array[::-1]
    extremes: list = {
        "i": [-1, -2, 7, 1000, 2**40, 2**63 - 1, -(2**63)],
        "f": [np.nan, np.inf, -np.inf, 1e300, -1e20, 0.0, -1.0],
        "b": [True, False],
        "u": [0, 255],
    }.get(array.dtype.kind, [])
    if array.dtype.kind == "i":
        held = np.iinfo(array.dtype)
        extremes = [value for value in extremes if held.min <= value <= held.max]
    for value in extremes if array.size else []:
        one = array.copy()
        one.reshape(-1)[rng.integers(one.size)] = value
        yield f"one is {value}", one
        yield f"all are {value}", np.full_like(array, value)


def tried(case: Case, after: list, path: Path) -> str:
    """What comes of a checkpoint: "refused", "went on", or a traceback."""
    run = Run(Listed(), case.make())
    try:
        run.load(path)
        for frame in after:
            run.take(frame)
        run.system.map(), run.system.summary(run.log), run.system.files(run.log)
        run.system.measurements("listed", run.log), run.log.states, [*map(run.log.observed, range(len(run.log)))]
    except InputError as error:
        return "refused" if "\n" not in str(error) and len(str(error)) > 10 else f"unclear: {error}"
    except Exception:
        return "traceback: " + " | ".join(traceback.format_exc().strip().splitlines()[-3:])
    return "went on"


def tell(name: str, damage: str, **result: str) -> None:
    print(json.dumps({"case": name, "damage": damage, **result}), flush=True)


def try_damages(name: str, folder: Path, most: int) -> None:
    """Tries so many damages of a case's checkpoint, in an order drawn at random."""
    case, rng = CASES[name], np.random.default_rng(0)
    run, frames = Run(Listed(), case.make()), list(case.frames())
    before, after = frames[: case.after[-1] + 1], frames[case.after[-1] + 1 :]
    for frame in before:
        run.take(frame)
    path = folder / "damaged.npz"
    run.save(path)
    tell(name, "none", result=tried(case, after, path))
    arrays = load_arrays(path)
    header = json.loads(str(arrays.pop("header")))
    # Of many arrays of one kind the first two are enough.
    names = [name for name in sorted(arrays) if name.split("/")[1:2] < ["2"] or not name.split("/")[1].isdigit()]
    every = [(key, *damage) for key in names for damage in damages(arrays[key], rng)]
    for k in rng.permutation(len(every))[:most]:
        key, words, value = every[k]
        tell(name, f"{key}: {words}")
        changed = {n: a for n, a in arrays.items() if n != key} | ({} if value is None else {key: value})
        save_arrays(path, {"header": np.array(json.dumps(header | {"digest": _digest(changed)})), **changed})
        tell(name, f"{key}: {words}", result=tried(case, after, path))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for each in CASES:
        try_damages(each, Path(sys.argv[1]), int(sys.argv[2]))
