"""Long-term operation: 100,000 frames of a camera and of a robot, in worlds whose points are replaced.

Both keep a fixed lag of their paths and drop landmarks that have not been observed for long. One row per 1,000 frames:
processor time per step, memory of the process and of all objects of the filter, and the error. Tables and plot show
whether anything grows.
"""

import gc
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import islice
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any, final

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.parallel import in_parallel
from examples.studies.streams import CameraStream, RobotStream, Turnover
from rbpf.core.filter import Filter
from rbpf.core.models import Belief, NewLandmarks, Observations, Sensor
from rbpf.lie import SE2, SE3
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.runs.files import write_table
from rbpf.runs.folder import peak_memory_mb
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam

Step = Callable[[Any, int], np.ndarray]
"""Filters a frame, counted from 0, and returns the estimated position (D,)."""


@dataclass(frozen=True)
class Window:
    """Consecutive frames.

    Attributes:
        frames: number of frames filtered up to its end.
        ms_per_frame: median processor time of a filter step, ms, independent of the machine's load.
        resident_mb: memory of the process at its end; its peak if the system does not provide it.
        held_kb: memory of all objects referenced by the filter.
        nodes: of the particles' ancestry.
        states: poses in the history.
        landmarks: in the map.
        started: landmarks ever started.
        error_m: RMS error of the position.
    """

    frames: int
    ms_per_frame: float
    resident_mb: float
    held_kb: float
    nodes: int
    states: int
    landmarks: int
    started: int
    error_m: float


COLUMNS = tuple(item.name for item in fields(Window))


@final
class Forgetting(Sensor):
    """A sensor that drops landmarks not observed for long, so that the map of a changing world is bounded.

    Args:
        inner: a sensor of named landmarks; frames have `landmarks` (K,), numbers.
        after: frames.
    """

    def __init__(self, inner: Sensor, after: int) -> None:
        self.inner = inner
        self.after = after
        self.frame = 0
        self._seen: dict[int, int] = {}

    def observe(self, frame: Any, belief: Belief) -> Sequence[Observations]:
        """The inner sensor's observations."""
        self.frame += 1
        self._seen.update(dict.fromkeys(frame.landmarks.tolist(), self.frame))
        return self.inner.observe(frame, belief)

    def new_landmarks(self, frame: Any, belief: Belief, observed: Sequence[Observations]) -> Sequence[NewLandmarks]:
        """The inner sensor's new landmarks, after dropping old ones."""
        new_landmarks = self.inner.new_landmarks(frame, belief, observed)
        old = [name for name, seen in self._seen.items() if self.frame - seen > self.after]
        ids = np.array(old, dtype=np.int64)
        belief.map.remove(ids[belief.map.holds(ids)])
        for name in old:
            del self._seen[name]
        return new_landmarks


def camera_steps(stream: CameraStream, config: MonoConfig, forget: int = 600) -> tuple[Filter, Step]:
    """The monocular system's filter for a stream, and its step function."""
    log = stream.first()
    assert isinstance(log.camera, Pinhole)
    slam = MonoSlam(log.camera, config, log.known, wrapped=lambda sensor: Forgetting(sensor, forget))

    def step(frame: Any, t: int) -> np.ndarray:
        return SE3.translation(slam.take(frame).pose)

    return slam.filter, step


def robot_steps(stream: RobotStream, config: RangeBearingConfig, forget: int = 600) -> tuple[Filter, Step]:
    """The range-bearing system's filter for a stream, and its step function."""
    slam = RangeBearingSlam.of_log(stream.first(), config)
    slam.filter.sensors = [Forgetting(slam.sensor, forget)]
    return slam.filter, lambda frame, _: slam.take(frame).pose[1:]


def soak(stream: CameraStream | RobotStream, filter_: Filter, step: Step, frames: int, every: int) -> Iterator[Window]:
    """Filters a stream; yields a window for every `every` frames.

    Args:
        stream: endless.
        filter_: the filter to be measured.
        step: its step function.
        frames: number of filtered frames.
        every: number of frames of a window.
    """
    seen = stream.frames()
    for first in range(0, frames, every):
        seconds, squares = [], []
        for t, (frame, pose) in enumerate(islice(seen, min(every, frames - first)), first):
            started = time.process_time()
            position = step(frame, t)
            seconds.append(time.process_time() - started)
            place = SE2.translation(pose) if pose.size == SE2.size else SE3.translation(pose)
            squares.append(float(np.square(position - place).sum()))
        yield _window(filter_, first + len(seconds), float(np.median(seconds)), float(np.mean(squares)))


def _window(filter_: Filter, frames: int, seconds: float, square: float) -> Window:
    landmark_map = filter_.belief().map
    assert isinstance(landmark_map, LandmarkMap)
    return Window(
        frames=frames,
        ms_per_frame=1e3 * seconds,
        resident_mb=resident_mb(),
        held_kb=held_bytes(filter_) / 1e3,
        nodes=filter_.lineage.nodes,
        states=filter_.history.stored_states,
        landmarks=landmark_map.ids.size,
        started=landmark_map.store.columns.next_id,
        error_m=float(np.sqrt(square)),
    )


def resident_mb() -> float:
    """Current memory of this process, MB of 2²⁰ bytes; its peak if the system does not provide it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return peak_memory_mb()
    import resource

    return pages * resource.getpagesize() / 2**20


def held_bytes(root: object) -> int:
    """Bytes of all objects and arrays referenced by an object, directly or indirectly, without code."""
    seen: set[int] = set()
    waiting, total = [root], 0
    while waiting:
        item = waiting.pop()
        while isinstance(item, np.ndarray) and item.base is not None:
            item = item.base
        if id(item) in seen or isinstance(item, type | ModuleType | FunctionType | MethodType):
            continue
        seen.add(id(item))
        total += sys.getsizeof(item)
        waiting.extend(gc.get_referents(item))
    return total


SYSTEMS = "camera", "robot"
SETTLED = 0.1
"""Fraction at the start of a run that fills the map and is not compared."""


@dataclass(frozen=True)
class Job:
    """One run."""

    system: str
    frames: int
    every: int
    particles: int
    lag: int
    out: Path


def run(job: Job) -> list[Window]:
    """Filters one stream; its table is written as it proceeds, and remains if the run is stopped."""
    turnover, windows = Turnover(), list[Window]()
    if job.system == "camera":
        camera = CameraStream(turnover, seed=0)
        done = soak(camera, *camera_steps(camera, MonoConfig(job.particles, lag=job.lag)), job.frames, job.every)
    else:
        robot = RobotStream(turnover, seed=0)
        config = RangeBearingConfig(job.particles, lag=job.lag)
        done = soak(robot, *robot_steps(robot, config), job.frames, job.every)
    for window in done:
        windows.append(window)
        write_table(job.out / f"{job.system}.csv", COLUMNS, [list(astuple(row)) for row in windows], shown=False)
    return windows


def growth(values: np.ndarray) -> float:
    """Median of the last third of a run over that of the first third, after the initial fraction."""
    settled = values[max(1, round(SETTLED * values.size)) :]
    third = max(1, settled.size // 3)
    return float(np.median(settled[-third:]) / np.median(settled[:third]))


def main(
    frames: int = 100_000,
    every: int = 1000,
    particles: int = 20,
    lag: int = 100,
    workers: int = 2,
    out: Path = Path("demo/soak"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs both and prints the table.

    Args:
        frames: of each stream.
        every: frames per row of the tables.
        particles: of both filters.
        lag: number of retained steps of the paths.
        workers: processes.
        out: folder for tables and picture.
        quick: a few frames, in this process.
    """
    if quick:
        frames, every, particles, lag, workers = 360, 60, 5, 20, 1
    jobs = [Job(system, frames, every, particles, lag, out) for system in SYSTEMS]
    columns, figures, rows = {}, {}, []
    for system, windows in zip(SYSTEMS, in_parallel(run, jobs, workers), strict=True):
        columns[system] = dict(zip(COLUMNS, np.array([astuple(w) for w in windows], dtype=float).T, strict=True))
        last = windows[-1]
        for name in ("ms_per_frame", "resident_mb", "held_kb", "nodes", "error_m"):
            figures[f"{system}, {name}"] = growth(columns[system][name])
        grown = [figures[f"{system}, {name}"] for name in ("ms_per_frame", "resident_mb", "held_kb", "error_m")]
        rows.append([system, last.frames, last.started, last.landmarks, *grown])
    header = ["stream", "frames", "landmarks ever", "at the end"]
    write_table(out / "growth.csv", [*header, "time x", "memory x", "held x", "error x"], rows)
    draw(columns, out / "soak.png")
    print(f"tables and picture in {out}; a growth of 1 is none")
    return figures


def draw(columns: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Plots time, memory, referenced objects and error by frame."""
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    shown = {
        "ms_per_frame": "median processor time of a step [ms]",
        "resident_mb": "memory of the process [MB]",
        "held_kb": "held by the filter [kB]",
        "error_m": "RMS error [m]",
    }
    for axes, (name, label) in zip(figure.subplots(2, 2).flat, shown.items(), strict=True):
        for system, column in columns.items():
            axes.plot(column["frames"], column[name], lw=1.0, label=system)
        axes.set(xlabel="frame", ylabel=label)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
