"""Worlds of points and their feature measurements by a camera: a `FeatureLog` with ground truth.

    log = simulate_features(DeskWorld(frames=300), Measuring(), MONO, seed=0)

A measurement is the true point's projection plus Gaussian noise, or an outlier. Points appear and disappear; they are
occluded by opaque blocks, and limited by distance and the image's border. A tracker with a fixed budget selects the
measured ones. Association and noise are known, and it is a hundred times faster than rendering images.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Protocol

import numpy as np

from examples.studies.lab import RATE_HZ, LabDrive, furnished, shell, spines, world_from_camera
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.ranges import MOST, Count, CountOrNone, NotNegative, Positive, Range, Ranged, Rate, check_ranges
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints, Truth
from rbpf.validation.simulation import textures
from rbpf.validation.simulation.paths import HandHeld, looking
from rbpf.validation.simulation.textured_scene import EPOCH_NS, stamps_ns

SURFACE = 1e-6
"""Tolerated fraction of the line of sight within a block: a point on its face is visible from the front."""

Draw = Callable[[int], np.ndarray]
"""Draws K positions (K, 3) in the world."""


@dataclass(frozen=True)
class Scene:
    """A realisation of a world.

    Attributes:
        name: of the world.
        stamps_ns: (T,) int64 times of the frames.
        world_from_camera: (T, 7) true poses at these times.
        points: (Q, 3) in the world, m.
        present: (Q, 2) int64, the frame in which a point appears and the one from which on it is gone.
        blocks: (B, 2, 3) least and greatest corner of opaque boxes, m.
    """

    name: str
    stamps_ns: np.ndarray
    world_from_camera: np.ndarray
    points: np.ndarray
    present: np.ndarray
    blocks: np.ndarray


class PointWorld(Protocol):
    """A random world of points."""

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws a realisation of the world."""
        ...


def hidden(eye: np.ndarray, points: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Whether a block occludes points (P, 3) from the eye (3,), by the slab method; (P,) bool."""
    around = np.concatenate([eye[None], points])
    near = (blocks[:, 0] <= around.max(axis=0)) & (blocks[:, 1] >= around.min(axis=0))
    low, high = np.moveaxis(blocks[near.all(axis=1)] - eye, 1, 0)
    enters, leaves = np.full((2, len(points), len(low)), [[[-np.inf]], [[np.inf]]])
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(3):
            ray = (points[:, axis] - eye[axis])[:, None]
            ends = low[:, axis] / ray, high[:, axis] / ray
            np.maximum(enters, np.minimum(*ends), out=enters)
            np.minimum(leaves, np.maximum(*ends), out=leaves)
    return np.asarray(((enters < leaves) & (leaves > 0.0) & (enters < 1.0 - SURFACE)).any(axis=-1))


def outside(draw: Draw, blocks: np.ndarray) -> Draw:
    """Rejects positions within a block."""

    def redraw(count: int) -> np.ndarray:
        points = draw(count)
        while True:
            within = (points[:, None] > blocks[:, 0]) & (points[:, None] < blocks[:, 1])
            if not (wrong := within.all(axis=-1).any(axis=-1)).any():
                return points
            points[wrong] = draw(int(wrong.sum()))

    return redraw


def populated(
    draw: Draw, count: int, frames: int, renewal: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points that are replaced by others elsewhere when they disappear.

    Args:
        draw: draws positions.
        count: number of points at any time.
        frames: of the recording.
        renewal: probability per frame that a point disappears.
        rng: generator.

    Returns:
        Positions (Q, 3) and frames (Q, 2), as in `Scene`; the first `count` are there in the first frame.
    """
    points, present = [], []
    start = np.zeros(count, dtype=np.int64)
    while start.size:
        life = rng.geometric(renewal, start.size) if renewal > 0.0 else frames
        end = np.minimum(start + life, frames)
        points.append(draw(start.size))
        present.append(np.stack([start, end], axis=-1))
        start = end[end < frames]
    return np.concatenate(points), np.concatenate(present)


@dataclass(frozen=True)
class DeskWorld(Ranged):
    """Points over a desk, observed by a hand-held camera.

    Attributes:
        frames: number of images.
        rate_hz: images per second.
        points: number of points at any time, uniform in a box with its base on z = 0 and its middle over the origin.
        size_m: of the box along x, y, z.
        hand: motion of the camera.
        blocks: number of opaque objects on the desk.
        renewal: fraction of the points that are replaced per second by others elsewhere.
    """

    frames: Annotated[int, Range(ge=2, le=MOST)] = 1000
    rate_hz: Positive = 30.0
    points: Count = 300
    size_m: tuple[Positive, Positive, Positive] = (2.0, 2.0, 1.0)
    hand: HandHeld = field(default_factory=HandHeld)
    blocks: CountOrNone = 3
    renewal: Rate = 0.0

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the points, the blocks and the path."""
        size, half = np.array(self.size_m), np.array(self.size_m) / 2
        extent = size * rng.uniform([0.04, 0.04, 0.1], [0.08, 0.08, 0.25], (self.blocks, 3))
        middle = size * rng.uniform(-0.4, 0.4, (self.blocks, 3))
        middle[:, 2] = extent[:, 2]
        blocks = np.stack([middle - extent, middle + extent], axis=1)
        draw = outside(lambda count: half * [0, 0, 1] + rng.uniform(-half, half, (count, 3)), blocks)
        points, present = populated(draw, self.points, self.frames, self.renewal / self.rate_hz, rng)
        path = self.hand.poses(np.arange(self.frames) / self.rate_hz, self.size_m, rng)
        return Scene("desk", stamps_ns(self.frames, self.rate_hz) - EPOCH_NS, path, points, present, blocks)


PRINTED = {textures.picture, textures.page, textures.carton, spines}
RICH = 20.0
"""Ratio of point densities of printed surfaces and of plain ones, such as paint, wood or carpet."""


@dataclass(frozen=True)
class LabWorld(Ranged):
    """Points on all visible surfaces of the `TexturedLab`; with the same seed both have the same furniture.

    All boxes occlude. Any camera can measure it:

        >>> log = simulate_features(LabWorld(LabDrive(frames=3), points=3000), Measuring(known=0), STEREO, seed=0)
        >>> len(log.frames), log.frames[0].z.shape
        (3, (25, 3))

    Attributes:
        drive: drive of the robot with the camera.
        points: number of points.
    """

    drive: LabDrive = field(default_factory=LabDrive)
    points: Count = 12000

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the furniture and the points."""
        lab = furnished(rng)
        surfaces = [*lab.surfaces, *(surface for surface, _ in shell())]
        blocks, images = np.array(lab.blocks), self.drive.images
        area_m2 = np.array([np.linalg.norm(np.cross(one.across, one.down)) for one in surfaces])
        weight = area_m2 * np.array([RICH if one.paint in PRINTED else 1.0 for one in surfaces])
        sides = np.array([[surface.across, surface.down] for surface in surfaces])
        corner = np.array([surface.corner for surface in surfaces])

        def draw(count: int) -> np.ndarray:
            """Positions (K, 3), uniform on each surface."""
            row = rng.choice(len(surfaces), count, p=weight / weight.sum())
            along = np.einsum("ks,ksx->kx", rng.random((count, 2)), sides[row])
            return np.asarray(corner[row] + along)

        points = outside(draw, blocks)(self.points)
        path = world_from_camera(self.drive.travelled().world_from_robot)[images]
        stamps = stamps_ns(int(images[-1]) + 1, RATE_HZ)[images] - EPOCH_NS
        present = np.tile([0, len(images)], (self.points, 1))
        return Scene("lab", stamps, path, points, present, blocks)


@dataclass(frozen=True)
class RoomWorld(Ranged):
    """Points on the walls of an empty room, 9 m wide, in which a camera moves in a circle.

    Attributes:
        frames: number of images.
        laps: number of laps, of 16 m.
        rate_hz: images per second.
        points: number of points.
    """

    frames: Annotated[int, Range(ge=2, le=MOST)] = 600
    laps: Positive = 2.0
    rate_hz: Positive = 10.0
    points: Count = 260

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the points, at most 0.8 m in front of a wall; the camera faces ahead and outwards."""
        turn = np.pi / 2.0 * rng.integers(0, 4, self.points)
        out, along = 4.5 - rng.uniform(0.0, 0.8, self.points), rng.uniform(-4.5, 4.5, self.points)
        cos, sin, up = np.cos(turn), np.sin(turn), rng.uniform(-1.5, 1.5, self.points)
        points = np.stack([cos * out - sin * along, sin * out + cos * along, up], axis=-1)
        angle = 2.0 * np.pi * self.laps * np.arange(self.frames) / self.frames
        place = np.stack([2.5 * np.cos(angle), 2.5 * np.sin(angle), 0.15 * np.sin(3.0 * angle)], axis=-1)
        ahead = np.stack([np.cos(angle + np.pi / 4), np.sin(angle + np.pi / 4), 0.1 * np.sin(5.0 * angle)], axis=-1)
        path, stamps = looking(place, ahead), stamps_ns(self.frames, self.rate_hz) - EPOCH_NS
        present, blocks = np.tile([0, self.frames], (self.points, 1)), np.zeros((0, 2, 3))
        return Scene("room", stamps, path, points, present, blocks)


COLUMNS, ROWS = 5, 4
"""Cells of the image: new tracks start in the cells with fewest tracks."""


class Tracker:
    """Continues tracks from frame to frame and starts new ones within a budget.

    Known points are measured first. Tracks continue while the point is visible. The remaining budget goes to visible
    points already in the map, then to new ones; both spread over the image.
    """

    def __init__(
        self, known: np.ndarray, count: int, measuring: "Measuring", image_px: np.ndarray, rng: np.random.Generator
    ) -> None:
        """Initialises before the first frame.

        Args:
            known: (M,) known points.
            count: number of points in the world, Q.
            measuring: numbers of measurements and durations of tracks.
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
        """Selects the points of the next frame.

        Args:
            visible: (Q,) bool.
            px: (Q, 2) pixels of the points; only visible ones are used.

        Returns:
            (K,) int64 rows of the points to measure.
        """
        measuring, known = self._measuring, self._known[visible[self._known]]
        # Tracks of the last frame whose points are visible and not lost.
        tracks = self._tracks[visible[self._tracks]]
        lost = self._rng.random(tracks.size) < measuring.turnover
        self._resting[tracks[lost]] = self._frame + measuring.rest_frames
        old = tracks[~lost][: measuring.measurements - known.size]
        # The remaining budget goes to points of the map, then to new ones.
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
        """Up to `count` candidates (a mask), each from a cell with fewest tracks."""
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
"""Points nearer to the border than this many standard deviations of the noise are not measured, as the border would
truncate the noise."""

RADIUS = 0.35
"""Size of the ellipse near which known points are chosen, relative to the image: its middle half."""

LEAST_SPREAD = 0.05
"""Known points are collinear if their extent across, in the image, is below this fraction of that along."""


@dataclass(frozen=True)
class Measuring:
    """Measurement of the visible points.

    Attributes:
        noise_px: standard deviation per coordinate.
        measurements: maximum number per frame.
        known: number of known points, around the middle of the first image. They are measured whenever they
            are visible, and never disappear.
        known_std_m: standard deviation per axis of their given positions.
        new_per_frame: maximum number of points that enter the map per frame; the first frame uses the whole budget.
        outlier_rate: probability that a measurement is uniform in the image; never the first one of a landmark.
        dropout: probability per frame that a tracked point is missed and its track continues.
        turnover: probability per frame that a tracked point is lost and replaced by another.
        rest_frames: number of frames in which a lost point is not searched.
        border_px: width of the image's border without measurements, as no patch fits.
        nearest_m: points nearer than this are not measured.
        farthest_m: points farther than this are not measured.
        occlusion: whether blocks occlude points.
    """

    noise_px: Positive = 1.0
    measurements: Count = 25
    known: CountOrNone = 4
    known_std_m: NotNegative = 0.001
    new_per_frame: CountOrNone = 3
    outlier_rate: Rate = 0.0
    dropout: Rate = 0.02
    turnover: Rate = 0.005
    rest_frames: CountOrNone = 15
    border_px: NotNegative = 8.0
    nearest_m: NotNegative = 0.2
    farthest_m: Positive = 8.0
    occlusion: bool = True

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.nearest_m < self.farthest_m:
            raise InputError(f"nearest_m = {self.nearest_m} must be less than farthest_m = {self.farthest_m}")


def simulate_features(
    world: PointWorld, measuring: Measuring, camera: Pinhole | RectifiedStereo, seed: int
) -> FeatureLog:
    """Simulates a recording; the same arguments give the same bytes.

    Args:
        world: points and the camera's path.
        measuring: selection and noise of measurements.
        camera: of the measurements.
        seed: of the only random generator.

    Returns:
        The log; landmarks are named by their rows among the world's points. The truth has all points that ever
        existed.

    Raises:
        InputError: too few points are visible in the first frame, or the known ones are collinear in it.
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
        # Outliers are uniform in the image; a stereo pair's disparity is positive.
        wrong = seen[rows] & (rng.random(rows.size) < measuring.outlier_rate)
        px = rng.uniform(0.0, size - 1.0, (int(wrong.sum()), 2))
        if not isinstance(camera, Pinhole):
            px = np.column_stack([px, rng.uniform(0.0, px[:, 0])])
        noisy[wrong] = px
        seen[rows] = True
        keep = camera.inside(noisy)
        cov = np.tile(measuring.noise_px**2 * np.eye(camera.dim), (int(keep.sum()), 1, 1))
        frames.append(FeatureFrame(stamp, rows[keep], noisy[keep], cov))
    truth = Truth(scene.stamps_ns, scene.world_from_camera, dict(enumerate(scene.points)))
    given = None
    if known.size:
        error = measuring.known_std_m * rng.standard_normal((known.size, 3))
        cov = np.tile(measuring.known_std_m**2 * np.eye(3), (known.size, 1, 1))
        given = KnownPoints(known, scene.points[known] + error, cov)
    return FeatureLog(f"simulated {scene.name}, seed {seed}", camera, frames, given, truth)


def _known(scene: Scene, measuring: Measuring, camera: Pinhole | RectifiedStereo, size: np.ndarray) -> np.ndarray:
    """(M,) rows of the known points, visible in the first frame, near an ellipse around the image's centre."""
    visible, z = _view(scene, measuring, camera, 0)
    wanted = measuring.known
    if wanted > measuring.measurements:
        raise InputError(f"{wanted} known points do not fit into {measuring.measurements} measurements per frame")
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
    """Visibility (Q,) of points in a frame, and their pixels (Q, p), meaningless for invisible ones."""
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
