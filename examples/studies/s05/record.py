"""Record of a run over the drive: rows of Table I, observations, and the resulting paths and maps."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from examples.studies.wheel_odometry import read_wheel_odometry
from rbpf.lie import SE3
from rbpf.runs.run import Run
from rbpf.runs.trajectory import align
from rbpf.runs.truth import poses_at
from rbpf.systems.stereo.landmarks import DescriptorLandmarks
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.system import Tracked

KINDS = "filter", "odometry", "wheels"


class Row(NamedTuple):
    """A row of Table I after a number of pairs: landmarks per particle, and candidates ever initialised."""

    pairs: int
    landmarks: int
    features: int


@dataclass
class Record:
    """Recorded data, pair by pair.

    Attributes:
        due: pairs after which a row of the table is due.
        rows: of the table.
        observations: names (k,), pair, points (k, 3) in the camera's frame.
        cpu: (T,) processor time of each pair, without its features.
    """

    due: tuple[int, ...]
    rows: list[Row] = field(default_factory=list)
    observations: list[tuple[np.ndarray, int, np.ndarray]] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    _clock: float = field(default_factory=time.process_time)

    def __call__(self, run: Run, tracked: Tracked) -> None:
        """Called after each pair."""
        now = time.process_time()
        self.cpu.append(now - self._clock)
        done, shown, manager = len(run.log), tracked.observed, landmarks_of(run).manager
        if tracked.values["updated"]:
            seen = shown["landmarks"] >= 0
            points = slam_of(run).rig.triangulate(shown["z"][seen])
            self.observations.append((shown["landmarks"][seen], done - 1, points))
        if done in self.due or done == run.expected:
            self.rows.append(Row(done, int(manager.confirmed.sum()), manager.next_name))
        self._clock = time.process_time()

    def places(self, path: np.ndarray, names: np.ndarray) -> np.ndarray:
        """Mean positions (M, 3) of landmarks (M,), ascending, along a path (T, 7)."""
        total, count = np.zeros((names.size, 3)), np.zeros(names.size)
        for seen, t, points in self.observations:
            row = np.minimum(np.searchsorted(names, seen), names.size - 1)
            held = names[row] == seen
            np.add.at(total, row[held], SE3.transform(path[t], points[held]))
            np.add.at(count, row[held], 1.0)
        return total / count[:, None]


class Paths(NamedTuple):
    """Poses (T, 7) of all pairs relative to the first camera."""

    truth: np.ndarray
    filter: np.ndarray
    odometry: np.ndarray
    wheels: np.ndarray


@dataclass(frozen=True)
class Best:
    """The particle with the highest weight at the end.

    Attributes:
        names: (M,) of its landmarks.
        places: (M, 3) their positions in its world.
        path: (U, 7) of its ancestors, at the updates.
        cloud: (N, 3) positions of all particles.
    """

    names: np.ndarray
    places: np.ndarray
    path: np.ndarray
    cloud: np.ndarray


def slam_of(run: Run) -> StereoSlam:
    """The system of a stereo run."""
    assert isinstance(run.system, StereoSlam)
    return run.system


def landmarks_of(run: Run) -> DescriptorLandmarks:
    """Descriptors and other data of a run's landmarks besides their estimates."""
    landmarks = slam_of(run).front_end.landmarks
    assert isinstance(landmarks, DescriptorLandmarks)
    return landmarks


def paths_of(run: Run, images: Path) -> Paths:
    """All four paths at the run's pairs."""
    wheels = read_wheel_odometry(images)
    by_wheels = wheels.world_from_camera(SE3.identity())
    _, by_wheels = poses_at(SE3, wheels.stamps_ns, by_wheels, run.log.stamps_ns)
    assert run.truth is not None and run.truth.rows.size == len(run.log)
    return Paths(run.truth.poses, run.log.poses, run.log["odometry"], SE3.between(by_wheels[0], by_wheels))


def best_particle(run: Run) -> Best:
    """Its map and its path, without any smoothing."""
    filter_, manager = run.system.filter, landmarks_of(run).manager
    belief = filter_.belief()
    names = manager.names[manager.confirmed]
    mode = belief.mode
    places = belief.read(names, np.array([mode])).mean[0]
    return Best(names, places, filter_.history.paths()[:, mode], SE3.translation(belief.state))


def errors(record: Record, paths: Paths, best: Best, updated: np.ndarray) -> dict[str, float]:
    """Root mean square errors of paths and maps in metres: in the first camera's world, then after rigid alignment."""
    pairs = {"path, best particle": (SE3.translation(best.path), SE3.translation(paths.truth[updated]))}
    true_places = record.places(paths.truth, best.names)
    pairs["map, best particle"] = best.places, true_places
    for name in KINDS:
        path = getattr(paths, name)
        pairs[f"path, {name}"] = SE3.translation(path), SE3.translation(paths.truth)
        pairs[f"map, {name}"] = record.places(path, best.names), true_places
    figures = {}
    for name, (ours, true) in pairs.items():
        figures[name] = rms(ours - true)
        figures[f"{name}, aligned"] = rms(align(ours, true).transform(ours) - true)
    for name in KINDS:
        off = SE3.translation(getattr(paths, name)[-1]) - SE3.translation(paths.truth[-1])
        figures[f"end, {name}"] = float(np.linalg.norm(off))
    return figures


def rms(off: np.ndarray) -> float:
    """Root mean square length of vectors (K, D)."""
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))
