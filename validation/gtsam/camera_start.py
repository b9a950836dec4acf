"""An initial estimate from scratch: the first camera from known points, then frame by frame.

A frame's pose is found from the landmarks placed so far; then the landmarks that it sees are triangulated, and placed
once their parallax tells their distance. From time to time all is adjusted, because errors would grow else.
"""

from dataclasses import replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.validation.gtsam.camera_adjust import adjust
from rbpf.validation.gtsam.camera_data import CameraEstimate, Sightings
from rbpf.validation.gtsam.camera_factors import evaluate_sightings
from rbpf.validation.gtsam.camera_graph import CameraProblem, CameraState
from rbpf.validation.gtsam.camera_points import (
    HUBER,
    first_centres,
    in_front,
    parallax,
    spread,
    triangulate,
)
from rbpf.validation.gtsam.camera_resection import Resected, locate, resect
from rbpf.validation.gtsam.solvers import ROUGH, OnIteration

KNOWN = 4
"""Known points that the first frame has to see."""
PLACED = 5.0
"""A landmark is placed once its inverse distance differs from zero by so many standard deviations."""
NEAREST = 0.2
"""Nor is it placed nearer than this fraction of the usual distance: near cameras that rest a point fits anything."""
CAP = 4.5
"""What one sighting of a single camera says for it at most, as a loss: one outlier must not do."""
GROWTH = 1.2
"""All is adjusted whenever the number of frames has grown by this factor."""
SETTLED = 30
"""A landmark seen more often moves only when all is adjusted."""
LOST = 10
"""As many frames in a row without three placed landmarks are the end."""

_EARLIEST = 8
_MOTION = 0.1  # of a frame: rad, and metres per metre of distance to what is seen


def from_scratch(
    name: str,
    stamps_ns: NDArray[np.int64],
    table: Sightings,
    known: dict[int, tuple[Array, Array]],
    on_iteration: OnIteration | None = None,
) -> CameraEstimate:
    """Path and landmarks from the known points, or for a stereo pair without any, from the first frame.

    Args:
        name: of the recording.
        stamps_ns: (T,) of the frames.
        table: its sightings.
        known: position and covariance of known points by name.
        on_iteration: told the error before each iteration of an adjustment on the way; what it raises ends it.

    Raises:
        InputError: the first frame sees fewer than four known points, a single camera has none, or the path breaks.
    """
    growth = _Growth(name, stamps_ns, table, known, on_iteration)
    growth.begin()
    for step in range(1, len(stamps_ns)):
        growth.add(step)
    return growth.estimate()


@final
class _Growth:
    """A path that grows frame by frame, and the landmarks placed so far."""

    def __init__(
        self,
        name: str,
        stamps_ns: NDArray[np.int64],
        table: Sightings,
        known: dict[int, tuple[Array, Array]],
        on_iteration: OnIteration | None,
    ) -> None:
        self.on_iteration = on_iteration
        self.name, self.stamps_ns, self.table, self.known = name, stamps_ns, table, known
        self.path = np.tile(SE3.identity(), (len(stamps_ns), 1))
        self.blur = np.zeros(len(stamps_ns))
        self.points = np.zeros((len(table.names), 3))
        self.cov = np.zeros((len(table.names), 3, 3))
        self.placed = np.isin(table.names, list(known))
        self.fixed = self.placed.copy()
        for index in np.flatnonzero(self.placed).tolist():
            self.points[index], self.cov[index] = known[int(table.names[index])]
        self.sightings = np.zeros(len(self.points), dtype=int)
        self.usual = 0.0
        self.adjusted = _EARLIEST
        self.blind = 0

    def begin(self) -> None:
        """Pose of the first frame."""
        rows = self._rows(0)
        seen = rows[self.placed[self.table.index[rows]]]
        if len(seen) < KNOWN and (self.known or not isinstance(self.table.camera, RectifiedStereo)):
            raise InputError(
                f"Frame 0 of {self.name} sees {len(seen)} known points, expected {KNOWN} or more to start from; "
                "add known points or give an initial estimate."
            )
        if self.known:
            part, points = self._part(seen)
            self._set(0, points, locate(part, points))
        self._place(0)

    def add(self, step: int) -> None:
        """Pose of the next frame, and the landmarks it adds."""
        rows = self._rows(step)
        seen = rows[self.placed[self.table.index[rows]]]
        self.blind = 0 if len(seen) >= 3 else self.blind + 1
        if self.blind == LOST:
            raise InputError(
                f"Frames {step - LOST + 1} to {step} of {self.name} see fewer than 3 landmarks whose place is known "
                "by then; give an initial estimate, or more known points."
            )
        self.path[step] = self.path[step - 1]
        if len(seen):
            part, points = self._part(seen)
            slope = evaluate_sightings(part, self.path[step : step + 1], points)[1][1]
            cov = slope @ self.cov[self.table.index[seen]] @ slope.mT
            part = replace(part, cov_z=part.cov_z + cov)
            self._set(step, points, resect(part, points, self.path[step], self._inertia(points, step)))
        self._place(step)
        if step + 1 >= GROWTH * self.adjusted:
            self.adjusted = step + 1
            self._adjust(step)

    def estimate(self) -> CameraEstimate:
        """What there is; landmarks never placed are missing."""
        names = self.table.names.tolist()
        landmarks = {names[i]: self.points[i] for i in np.flatnonzero(self.placed).tolist()}
        return CameraEstimate(self.path, landmarks)

    def _rows(self, step: int) -> NDArray[np.intp]:
        first, last = np.searchsorted(self.table.steps, [step, step + 1])
        return np.arange(first, last)

    def _part(self, rows: NDArray[np.intp]) -> tuple[Sightings, Array]:
        # Sightings of one frame, and the places of their landmarks.
        part = self.table.rows(rows)
        alone = replace(part, steps=np.zeros_like(part.steps))
        return alone, self.points[np.searchsorted(self.table.names, part.names)]

    def _set(self, step: int, points: Array, found: Resected) -> None:
        # An error of the camera's place is one of the rays: as pixels at the distance of what it sees.
        self.path[step] = found.pose
        focal = float(np.linalg.norm(self.table.camera.jacobian(np.array([0.0, 0.0, 1.0]))[0]))
        self.usual = self._distance(points, step)
        fraction = np.sqrt(np.trace(found.cov[3:, 3:]) / 3) / self.usual
        self.blur[step] = (focal * fraction) ** 2

    def _distance(self, points: Array, step: int) -> float:
        return float(np.median(np.linalg.norm(points - SE3.translation(self.path[step]), axis=1)))

    def _inertia(self, points: Array, step: int) -> Array:
        return np.diag(np.repeat([_MOTION, _MOTION * self._distance(points, step)], 3) ** -2.0)

    def _place(self, step: int) -> None:
        # Triangulates the landmarks of this frame from all frames so far, unless they are long settled.
        now = self.table.index[self._rows(step)]
        self.sightings[now] += 1
        seen = np.zeros(len(self.points), dtype=bool)
        seen[now] = True
        last = np.searchsorted(self.table.steps, step + 1)
        settled = self.fixed | (self.placed & (self.sightings > SETTLED))
        rows = np.flatnonzero((seen & ~settled)[self.table.index[:last]])
        if not rows.size:
            return
        part = self._blurred(self.table.rows(rows))
        points = triangulate(part, self.path)
        good = self._good(part, self.path, points)
        index = np.searchsorted(self.table.names, part.names[good])
        self.points[index], self.placed[index] = points[good], True
        self.cov[index] = spread(part, self.path, points)[good]

    def _adjust(self, step: int) -> None:
        last = np.searchsorted(self.table.steps, step + 1)
        part = self.table.rows(np.flatnonzero(self.placed[self.table.index[:last]]))
        before = np.searchsorted(self.table.names, part.names)
        problem = CameraProblem(self.name, self.stamps_ns[: step + 1], part, self.known, HUBER)
        start = CameraState(self.path[: step + 1], self.points[before], np.empty((0, 6)))
        found = adjust(problem, start, ROUGH, self.on_iteration)
        state, part = found.state, found.problem.table
        index = np.searchsorted(self.table.names, part.names)
        self.placed[before] = False
        self.path[: step + 1], self.points[index] = state.path, state.points
        part = self._blurred(part)
        good = self._good(part, state.path, state.points)
        self.placed[index] = self.fixed[index] | good
        free = ~self.fixed[index]
        self.cov[index[free]] = spread(part, state.path, state.points)[free]

    def _good(self, part: Sightings, path: Array, points: Array) -> NDArray[np.bool_]:
        cap = np.inf if isinstance(part.camera, RectifiedStereo) else CAP
        distance = np.linalg.norm(points - first_centres(part, path), axis=1)
        far = distance > NEAREST * self.usual
        return far & in_front(part, path, points) & (parallax(part, path, points, cap) > PLACED)

    def _blurred(self, part: Sightings) -> Sightings:
        blur = self.blur[part.steps][:, None, None] * np.eye(part.z.shape[1])
        return replace(part, cov_z=part.cov_z + blur)
