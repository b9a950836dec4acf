"""Does a filter with a fixed lag run for ever? Time and memory, thousand frames by thousand frames."""

import gc
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any, final

import numpy as np

from rbpf.core.anchoring import StartAnchor
from rbpf.core.belief import Belief
from rbpf.core.filter import Filter
from rbpf.core.models import NewLandmarks, Observations, Sensor
from rbpf.lie import SE2, SE3
from rbpf.runs.folder import peak_memory_mb
from rbpf.sensors.catalogue_index import NameIndex
from rbpf.systems.mono import system as mono
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import pose_estimate
from rbpf.systems.range_bearing import system as range_bearing
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.simulation.streams import CameraStream, RobotStream

Step = Callable[[Any, int], np.ndarray]
"""Filters a frame, the first one being number 0, and tells the position (D,) that it estimates."""


@dataclass(frozen=True)
class Window:
    """Some frames in a row.

    Attributes:
        frames: filtered up to its end.
        ms_per_frame: median time that the processor spends on a filter step, ms; what else the machine does is not
            in it.
        resident_mb: memory of the process at its end; its peak where the system does not tell.
        held_kb: all that the filter refers to.
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
    """A sensor that drops landmarks which have not been seen for long, so that the map of a changing world is bounded.

    Args:
        inner: a sensor of named landmarks; frames have `landmarks` (K,), numbers.
        after: frames.
    """

    def __init__(self, inner: Sensor, after: int) -> None:
        self.inner = inner
        self.after = after
        self.frame = 0
        self._seen: dict[int, int] = {}
        self._names = NameIndex()

    def observe(self, frame: Any, belief: Belief) -> Sequence[Observations]:
        """What the inner sensor observes."""
        self.frame += 1
        self._seen.update(dict.fromkeys(frame.landmarks.tolist(), self.frame))
        return self.inner.observe(frame, belief)

    def new_landmarks(
        self, frame: Any, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """What the inner sensor starts, after the old ones have gone."""
        new_landmarks = self.inner.new_landmarks(frame, belief, observed)
        old = [name for name, seen in self._seen.items() if self.frame - seen > self.after]
        known = self._names.ids(belief.catalogue)
        ids = np.array([known.get(name, name) for name in old], dtype=np.int64)
        belief.map.remove(ids[belief.map.holds(ids)])
        for name in old:
            del self._seen[name]
        return new_landmarks


def camera_steps(stream: CameraStream, config: MonoConfig, forget: int = 600) -> tuple[Filter, Step]:
    """The monocular system's filter over a stream, and what makes its steps."""
    log = stream.first()
    filter_ = mono.build_filter(log, config, lambda sensor: Forgetting(sensor, forget))
    law = mono.start_prior(log, config)

    def step(frame: Any, t: int) -> np.ndarray:
        report = filter_.step(frame, law if t == 0 else None, frame.stamp_ns)
        return SE3.translation(pose_estimate(filter_, report).mean)

    return filter_, step


def robot_steps(stream: RobotStream, config: RangeBearingConfig, forget: int = 600) -> tuple[Filter, Step]:
    """The range-bearing system's filter over a stream, and what makes its steps."""
    log = stream.first()
    filter_ = range_bearing.build_filter(log, config, lambda sensor: Forgetting(sensor, forget))
    anchor = StartAnchor(filter_, config.anchor_every)

    def step(frame: Any, t: int) -> np.ndarray:
        control = range_bearing.control_of(frame)
        report = filter_.step(frame, control, frame.stamp_ns)
        return anchor.state_estimate(anchor.after_step(report, control)).mean[1:]

    return filter_, step


def soak(
    stream: CameraStream | RobotStream, filter_: Filter, step: Step, frames: int, every: int
) -> Iterator[Window]:
    """Filters a stream; one window for every so many frames.

    Args:
        stream: endless.
        filter_: that is looked at.
        step: makes its steps.
        frames: of the stream that are filtered.
        every: frames of a window.
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
    return Window(
        frames=frames,
        ms_per_frame=1e3 * seconds,
        resident_mb=resident_mb(),
        held_kb=held_bytes(filter_) / 1e3,
        nodes=filter_.lineage.nodes,
        states=filter_.history.stored_states,
        landmarks=landmark_map.ids.size,
        started=landmark_map.store.next_id,
        error_m=float(np.sqrt(square)),
    )


def resident_mb() -> float:
    """Memory of this process now, MB of 2²⁰ bytes; where the system does not tell, its peak."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return peak_memory_mb()
    import resource

    return pages * resource.getpagesize() / 2**20


def held_bytes(root: object) -> int:
    """Bytes of all objects and arrays that an object refers to, directly or not; code is left out."""
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
