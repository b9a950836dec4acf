"""Simulates what a camera measures of a world of points, feature by feature, as a `FeatureLog` with ground truth.

A measurement is the true point's projection plus Gaussian noise, or an outlier. Points are hidden by opaque blocks, by
distance and by the image's border. Which of the visible ones are measured is up to a tracker with a fixed budget.
"""

from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import CameraTruth, FeatureFrame, FeatureLog, KnownPoints
from rbpf.validation.simulation.limits import (
    check_counts,
    check_fractions,
    check_not_negative,
    check_order,
    check_positive,
)
from rbpf.validation.simulation.point_worlds import PointWorld, Scene, hidden

COLUMNS, ROWS = 5, 4
"""Cells of the image: new tracks begin where the cells hold fewest."""


class Tracker:
    """Keeps tracks from frame to frame and begins others where places are free.

    Points known beforehand are measured first. Tracks go on while the point is visible. Free places go to visible
    points that are in the map already, then to new ones; both spread over the image.
    """

    def __init__(
        self,
        known: np.ndarray,
        count: int,
        measuring: "Measuring",
        image_px: np.ndarray,
        rng: np.random.Generator,
    ) -> None:
        """Starts before the first frame.

        Args:
            known: (M,) points known beforehand.
            count: of points in the world, Q.
            measuring: how many are measured, and how long.
            image_px: width and height.
            rng: generator.
        """
        self._known, self._measuring = known, measuring
        self._cell_px = image_px / [COLUMNS, ROWS]
        self._rng = rng
        self._tracks = np.zeros(0, dtype=np.int64)
        self._mapped = np.zeros(count, dtype=bool)
        self._resting = np.zeros(count, dtype=np.int64)
        self._unknown = np.ones(count, dtype=bool)
        self._unknown[known] = False
        self._frame = 0

    def step(self, visible: np.ndarray, px: np.ndarray) -> np.ndarray:
        """Goes on by one frame.

        Args:
            visible: (Q,) bool.
            px: (Q, 2) where the points are in the image; only the visible ones count.

        Returns:
            (K,) int64 rows of the points to measure.
        """
        measuring, known = self._measuring, self._known[visible[self._known]]
        # Tracks of the last frame whose points are visible and not lost.
        tracks = self._tracks[visible[self._tracks]]
        lost = self._rng.random(tracks.size) < measuring.turnover
        self._resting[tracks[lost]] = self._frame + measuring.rest_frames
        old = tracks[~lost][: measuring.measurements - known.size]
        # Free places go to points of the map, then to new ones.
        taken = np.concatenate([known, old])
        free = visible & self._unknown & (self._resting <= self._frame)
        free[old] = False
        again = self._begin(free & self._mapped, taken, px, measuring.measurements - taken.size)
        taken = np.concatenate([taken, again])
        room = measuring.measurements - taken.size
        most = min(room, measuring.new_per_frame) if self._frame else room
        new = self._begin(free & ~self._mapped, taken, px, most)
        self._mapped[new] = True
        self._tracks = np.concatenate([old, again, new])
        dropout = measuring.dropout if self._frame else 0.0
        measured = self._rng.random(known.size + old.size) >= dropout
        self._frame += 1
        return np.concatenate([np.concatenate([known, old])[measured], again, new])

    def _begin(self, candidates: np.ndarray, taken: np.ndarray, px: np.ndarray, count: int) -> np.ndarray:
        """Up to `count` candidates (a mask), one after the other from a cell that holds fewest."""
        choice = self._rng.permutation(np.flatnonzero(candidates))
        chosen = np.zeros(min(count, choice.size), dtype=np.int64)
        cell = self._cell(px[choice])
        filled = np.bincount(self._cell(px[taken]), minlength=COLUMNS * ROWS)
        for place in range(chosen.size):
            best = int(np.argmin(filled[cell]))
            chosen[place] = choice[best]
            filled[cell[best]] += 1
            choice, cell = np.delete(choice, best), np.delete(cell, best)
        return chosen

    def _cell(self, px: np.ndarray) -> np.ndarray:
        """Cell (K,) of pixels (K, 2)."""
        column, row = np.clip((px / self._cell_px).astype(np.int64), 0, [COLUMNS - 1, ROWS - 1]).T
        return row * COLUMNS + column


MONO = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
STEREO = RectifiedStereo(MONO, 0.12)

CERTAIN = 5.0
"""Points nearer to the border than this many standard deviations of the noise are not measured: the noise would have
to be cut off at the border."""

RADIUS = 0.35
"""Of the ellipse near which the known points are chosen, as a fraction of the image's size: in its middle half."""

LEAST_SPREAD = 0.05
"""Known points are on a line if they extend, in the image, less than this fraction of their length to the side."""


@dataclass(frozen=True)
class Measuring:
    """How the visible points are measured.

    Attributes:
        noise_px: standard deviation per coordinate.
        measurements: most of them per frame.
        known: number of points known beforehand, around the middle of the first image. They are measured whenever they
            are visible, and never disappear.
        known_std_m: standard deviation per axis of their given positions.
        new_per_frame: most points that enter the map per frame; the first frame takes as many as fit.
        outlier_rate: probability that a measurement lies anywhere in the image; never that which begins a landmark.
        dropout: probability per frame that a tracked point is missed and its track goes on.
        turnover: probability per frame that a tracked point is lost and its place given to another.
        rest_frames: a lost point is not looked for during these.
        border_px: no patch fits into the image's border of this width.
        nearest_m: points nearer than this are not recognised.
        farthest_m: nor those farther away.
        occlusion: whether blocks hide what is behind them.
    """

    noise_px: float = 1.0
    measurements: int = 25
    known: int = 4
    known_std_m: float = 0.001
    new_per_frame: int = 3
    outlier_rate: float = 0.0
    dropout: float = 0.02
    turnover: float = 0.005
    rest_frames: int = 15
    border_px: float = 8.0
    nearest_m: float = 0.2
    farthest_m: float = 8.0
    occlusion: bool = True

    def __post_init__(self) -> None:
        """Checks that the numbers make sense."""
        check_counts(self, {"measurements": 1, "known": 0, "new_per_frame": 0, "rest_frames": 0})
        check_positive(self, "noise_px", "farthest_m")
        check_not_negative(self, "known_std_m", "border_px", "nearest_m")
        check_fractions(self, "outlier_rate", "dropout", "turnover")
        check_order(self, "nearest_m", "farthest_m")


def simulate_features(
    world: PointWorld, measuring: Measuring, camera: Pinhole | RectifiedStereo, seed: int
) -> FeatureLog:
    """Simulates a recording; the same arguments give the same bytes.

    Args:
        world: where the camera goes and what is there.
        measuring: which points are measured, and how well.
        camera: that measures.
        seed: of the only random generator.

    Returns:
        The log; landmarks are named by their rows among the world's points. The truth has every point that was ever
        there.

    Raises:
        InputError: too few points are visible in the first frame, or those known lie on a line in it.
    """
    rng = np.random.default_rng(seed)
    scene = world.build(rng)
    image = camera if isinstance(camera, Pinhole) else camera.camera
    size = np.array([image.width, image.height], dtype=float)
    known = _known(scene, measuring, camera, size)
    scene.present[known, 1] = len(scene.stamps_ns)
    tracker = Tracker(known, len(scene.points), measuring, size, rng)
    seen = np.zeros(len(scene.points), dtype=bool)
    frames = []
    for frame, stamp in enumerate(scene.stamps_ns.tolist()):
        visible, z = _view(scene, measuring, camera, frame)
        rows = tracker.step(visible, z[:, :2])
        noisy = z[rows] + measuring.noise_px * rng.standard_normal((rows.size, camera.dim))
        # Outliers lie anywhere in the image; a stereo pair's disparity is positive.
        wrong = seen[rows] & (rng.random(rows.size) < measuring.outlier_rate)
        px = rng.uniform(0.0, size - 1.0, (int(wrong.sum()), 2))
        if not isinstance(camera, Pinhole):
            px = np.column_stack([px, rng.uniform(0.0, px[:, 0])])
        noisy[wrong] = px
        seen[rows] = True
        keep = camera.inside(noisy)
        cov = np.tile(measuring.noise_px**2 * np.eye(camera.dim), (int(keep.sum()), 1, 1))
        frames.append(FeatureFrame(stamp, rows[keep], noisy[keep], cov))
    truth = CameraTruth(scene.stamps_ns, scene.world_from_camera, dict(enumerate(scene.points)))
    given = None
    if known.size:
        error = measuring.known_std_m * rng.standard_normal((known.size, 3))
        cov = np.tile(measuring.known_std_m**2 * np.eye(3), (known.size, 1, 1))
        given = KnownPoints(known, scene.points[known] + error, cov)
    return FeatureLog(f"simulated {scene.name}, seed {seed}", camera, frames, given, truth)


def _known(
    scene: Scene, measuring: Measuring, camera: Pinhole | RectifiedStereo, size: np.ndarray
) -> np.ndarray:
    """(M,) rows of the points known beforehand, visible in the first frame, near an ellipse about the image's middle."""
    visible, z = _view(scene, measuring, camera, 0)
    wanted = measuring.known
    if wanted > measuring.measurements:
        raise InputError(
            f"{wanted} known points do not fit into {measuring.measurements} measurements per frame"
        )
    seen = np.flatnonzero(visible)
    if len(seen) < wanted:
        raise InputError(
            f"the first frame of the {scene.name} sees {len(seen)} points that can be known, expected {wanted}: "
            "simulate more points, fewer known ones or another place of the camera"
        )
    angle = 2.0 * np.pi * (np.arange(wanted) + 0.5) / max(wanted, 1)
    places = size * (0.5 + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    free, rows = np.ones(len(seen), dtype=bool), np.zeros(wanted, dtype=np.int64)
    for k, place in enumerate(places):
        distance = np.linalg.norm(z[seen, :2] - place, axis=1)
        rows[k] = np.argmin(np.where(free, distance, np.inf))
        free[rows[k]] = False
    px = z[seen[rows], :2]
    extent = np.linalg.svd(px - px.mean(axis=0), compute_uv=False) if wanted > 2 else np.ones(2)
    if extent[1] < LEAST_SPREAD * extent[0]:
        raise InputError(
            f"the known points of the {scene.name} lie on a line in the first frame: use another seed or more points"
        )
    return np.asarray(seen[rows])


def _view(
    scene: Scene, measuring: Measuring, camera: Pinhole | RectifiedStereo, frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Which points (Q,) the camera sees in a frame, and where (Q, p); pixels of the others mean nothing."""
    pose = scene.world_from_camera[frame]
    local = SE3.inverse_transform(pose, scene.points)
    distance = np.linalg.norm(local, axis=1)
    there = (scene.present[:, 0] <= frame) & (frame < scene.present[:, 1])
    near = (distance >= measuring.nearest_m) & (distance <= measuring.farthest_m)
    visible = there & near & camera.visible(local, measuring.border_px + CERTAIN * measuring.noise_px)
    if measuring.occlusion and len(scene.blocks):
        rows = np.flatnonzero(visible)
        visible[rows] = ~hidden(SE3.translation(pose), scene.points[rows], scene.blocks)
    return visible, camera.project(local)
