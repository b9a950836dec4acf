"""The batch adjustment of the measurements that a run over images used: what the filter could have known at best."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rbpf.errors import InputError
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.validation.gtsam.camera import CameraEstimate, CameraSolution, solve_features

ROBUST = 1.345
"""Threshold of Huber's loss on whitened observations, in standard deviations: a wrong match does little harm."""

LEAST = 4
"""Landmarks known, or seen in other frames too, that a frame needs to take part: three leave several poses."""

EXACT = 1e-4
"""Known points without errors get one of this fraction of their extent: constraints take GTSAM many times as long."""

WORK = 30_000_000
"""Sightings that are linearised, over all iterations, before an adjustment is given up: some minutes of work. Work is
counted and not the time, so that a result does not depend on what else the machine does."""

LEAST_ITERATIONS = 100
"""That are allowed however many sightings there are."""

Told = Callable[[int, float], None]
"""Told the number of an iteration and the error before it."""


@dataclass(frozen=True)
class Batch:
    """The batch optimum of a log.

    Attributes:
        log: what was adjusted, with the frames that took part.
        frames: (B,) numbers of these frames.
        solution: the optimum; its poses are those of the B frames.
    """

    log: FeatureLog
    frames: NDArray[np.intp]
    solution: CameraSolution

    @property
    def world_from_camera(self) -> np.ndarray:
        """(B, 7) poses of the frames that took part."""
        return self.solution.world_from_camera

    @property
    def trajectory(self) -> Trajectory:
        """The same with their stamps."""
        stamps = np.array([frame.stamp_ns for frame in self.log.frames], dtype=np.int64)
        return Trajectory(stamps, self.world_from_camera)


def adjust_log(
    log: FeatureLog,
    world_from_camera: np.ndarray,
    most: int | None = None,
    on_iteration: Told | None = None,
    twice: bool = True,
    tolerance: float | None = None,
    robust: float | None = ROBUST,
    marginals: bool = False,
) -> Batch:
    """Adjusts all frames that the first one is connected with through landmarks.

    Known points allow a second start, from them alone, frame by frame: the better optimum counts, so that it does not
    hang on where the filter went. Without known points the first pose, and the scale of the start, are held.

    Args:
        log: T frames of one camera.
        world_from_camera: (T, 7) poses to start from.
        most: iterations, over both starts, after which it is given up; by default `most_iterations`.
        on_iteration: told how far it is.
        twice: also start from the known points alone; not needed near the optimum.
        tolerance: see `solve_features`.
        robust: see `solve_features`.
        marginals: compute covariances too; where the measurements do not determine all of them, the solution has none.

    Raises:
        InputError: too few frames are connected, it takes too many iterations, or it does not converge.
    """
    frames = connected_frames(log)
    if frames.size < 2:
        raise InputError(f"{log.name}: no two frames share the {LEAST} landmarks that a batch adjustment needs of each")
    part = replace(log, frames=[log.frames[t] for t in frames], known=softened(log.known))
    watch = _Watch(most_iterations(part) if most is None else most, on_iteration)
    start = CameraEstimate(world_from_camera[frames], {})
    starts = [start, None] if twice and log.known is not None else [start]
    solution = _best(part, starts, watch, tolerance, robust)
    if marginals:
        best = CameraEstimate(solution.world_from_camera, solution.landmarks)
        with suppress(InputError):
            solution = solve_features(part, best, robust=robust, on_iteration=watch, tolerance=tolerance)
    return Batch(replace(part, known=log.known), frames, solution)


def most_iterations(log: FeatureLog) -> int:
    """Iterations that the adjustment of a log may take."""
    return max(LEAST_ITERATIONS, WORK // max(sum(frame.landmarks.size for frame in log.frames), 1))


def softened(known: KnownPoints | None) -> KnownPoints | None:
    """The known points, with small errors where they have none."""
    if known is None or known.cov.any():
        return known
    extent = float(np.ptp(known.positions, axis=0).max())
    return replace(known, cov=np.tile((EXACT * extent) ** 2 * np.eye(3), (known.names.size, 1, 1)))


def _best(
    log: FeatureLog,
    starts: Sequence[CameraEstimate | None],
    watch: "_Watch",
    tolerance: float | None,
    robust: float | None,
) -> CameraSolution:
    """The solution of least error; a start that leads nowhere is passed over, if another one does not."""
    found: list[CameraSolution] = []
    problem: InputError | None = None
    for start in starts:
        try:
            found.append(
                solve_features(log, start, robust=robust, marginals=False, on_iteration=watch, tolerance=tolerance)
            )
        except InputError as error:
            problem = error
    if not found:
        assert problem is not None
        raise problem
    return min(found, key=lambda solution: solution.error)


def connected_frames(log: FeatureLog) -> NDArray[np.intp]:
    """Numbers (B,) of the frames that can be adjusted together with the first one, or with most of the others.

    Each sees `LEAST` landmarks that are known or seen in another of them, and they are connected by these.
    """
    counts = np.array([frame.landmarks.size for frame in log.frames])
    steps = np.repeat(np.arange(counts.size), counts)
    names, index = np.unique(np.concatenate([f.landmarks for f in log.frames]), return_inverse=True)
    known = np.isin(names, () if log.known is None else log.known.names)
    kept = np.ones(counts.size, dtype=bool)
    while True:
        rows = kept[steps]
        shared = known | (np.bincount(index[rows], minlength=names.size) > 1)
        rows &= shared[index]
        enough = np.bincount(steps[rows], minlength=counts.size) >= LEAST
        now = kept & enough & _with_the_first(steps[rows], index[rows], counts.size, known)
        if (now == kept).all() or not now.any():
            return np.flatnonzero(now)
        kept = now


def _with_the_first(
    steps: NDArray[np.intp], index: NDArray[np.intp], frames: int, known: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which frames are in one piece with the known points, else with the first frame that sees anything."""
    if not steps.size:
        return np.zeros(frames, dtype=bool)
    of_group = np.flatnonzero(known)
    ends = np.concatenate([index, of_group]) + frames
    starts = np.concatenate([steps, frames + np.repeat(of_group[:1], of_group.size)])
    size = frames + known.size
    _, piece = connected_components(csr_array((np.ones(ends.size), (starts, ends)), shape=(size, size)), False)
    anchor = frames + of_group[0] if of_group.size else steps[0]
    return np.asarray(piece[:frames] == piece[anchor])


@final
class _Watch:
    """Counts iterations, and stops them when there have been enough."""

    def __init__(self, most: int, told: Told | None) -> None:
        self.most, self.told, self.count = most, told, 0

    def __call__(self, error: float) -> None:
        self.count += 1
        if self.told is not None:
            self.told(self.count, error)
        if self.count > self.most:
            raise InputError(
                f"the batch adjustment was given up after {self.most} iterations: allow more with --batch-limit"
            )
