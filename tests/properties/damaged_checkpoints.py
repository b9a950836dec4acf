"""Resumes runs from checkpoints of which one array is damaged and the digest right; see `test_damaged_checkpoints`.

A program of its own, since what compiled code does with a wrong index may end the process. Each case is told before it is
tried, and what came of it after.
"""

import json
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rbpf.core.checkpoint import _digest, load_arrays, save_arrays
from rbpf.errors import InputError
from rbpf.runs.run import Run
from rbpf.systems.mono.config import MonoConfig, StartConfig
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.systems.stereo.config import StereoConfig, TriggerConfig
from rbpf.systems.stereo.front_end import NamedFrontEnd
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.system import System


@dataclass
class Case:
    """A system, frames before the checkpoint, and frames after it."""

    make: Callable[[], System]
    before: list
    after: list


@dataclass
class Listed:
    """A recording."""

    name: str = "listed"

    def frames(self, start: int = 0) -> Iterator[object]:
        raise NotImplementedError


def mono(known: bool) -> Case:
    from tests.systems.plane_sequences import CAMERA, known_points, sequence

    config, points = MonoConfig(particles=4), known_points() if known else None
    frames = list(sequence(11).frames())
    return Case(lambda: MonoSlam(CAMERA, config, points), frames[:9], frames[9:])


def named(known: bool) -> Case:
    from tests.systems.mono_logs import SMALL, desk, without_known

    log = desk(2, frames=10)
    config = replace(SMALL, start=StartConfig(first_adjustment=4))
    used = log if known else without_known(log)
    return Case(lambda: MonoSlam(log.camera, config, used.known), used.frames[:8], used.frames[8:])


def stereo() -> Case:
    from tests.systems.stereo_sequences import pairs

    sequence = pairs(7)
    frames = list(sequence.frames())
    config = StereoConfig(particles=10, trigger=TriggerConfig(0.0, 0.0))
    return Case(lambda: StereoSlam(sequence.rig, config), frames[:6], frames[6:])


def named_stereo() -> Case:
    from examples.studies.lab import LabDrive
    from examples.studies.point_worlds import STEREO, LabWorld, Measuring, simulate_features

    world = LabWorld(LabDrive(frames=8, every=4), points=2000)
    log = simulate_features(world, Measuring(known=0, measurements=20, new_per_frame=20), STEREO, 0)
    config = StereoConfig(particles=10, trigger=TriggerConfig(0.0, 0.0))
    make = lambda: StereoSlam(log.camera, config, front_end=NamedFrontEnd(log.camera, config))  # noqa: E731
    return Case(make, log.frames[:6], log.frames[6:])


def robot(**options: str) -> Case:
    from tempfile import TemporaryDirectory

    from rbpf.sensors.readers import open_log
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(steps=24, landmarks=8), Path(folder), seed=0)
        log = open_log(Path(folder))
    config = RangeBearingConfig(particles=4, anchor_every=3, **options)
    return Case(lambda: RangeBearingSlam.of_log(log, config), log.frames[:20], log.frames[20:])


def returning() -> Case:
    from examples.studies.hypotheses import corridor

    log, config = corridor(0), RangeBearingConfig(particles=4, association="ml", map="joint")
    return Case(
        lambda: RangeBearingSlam.of_log(log, config, keep_associations=True), log.frames[:59], log.frames[59:63]
    )


CASES: dict[str, Callable[[], Case]] = {
    "mono": lambda: mono(True),
    "mono, nothing known": lambda: mono(False),
    "named features": lambda: named(True),
    "named features, nothing known": lambda: named(False),
    "stereo": stereo,
    "named stereo": named_stereo,
    "robot": lambda: robot(map="particles"),
    "robot, hypotheses": returning,
    "robot, joint map": robot,
}


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


def tried(case: Case, path: Path) -> str:
    """What comes of a checkpoint: "refused", "went on", or a traceback."""
    run = Run(Listed(), case.make())
    try:
        run.load(path)
        for frame in case.after:
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
    case, rng = CASES[name](), np.random.default_rng(0)
    run = Run(Listed(), case.make())
    for frame in case.before:
        run.take(frame)
    path = folder / "damaged.npz"
    run.save(path)
    tell(name, "none", result=tried(case, path))
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
        tell(name, f"{key}: {words}", result=tried(case, path))


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for each in CASES:
        try_damages(each, Path(sys.argv[1]), int(sys.argv[2]))
