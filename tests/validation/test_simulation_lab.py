"""The simulated laboratory: plan, drives, furniture, its twin in points, and its images."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from examples.studies.point_worlds import LabWorld, Measuring, simulate_features
from rbpf.lie import SE2, SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import open_images, open_stereo
from rbpf.sensors.readers.wheel_odometry import read_wheel_odometry
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.lab import (
    DOOR_M,
    LINTEL_M,
    PARTITION_M,
    RATE_HZ,
    ROBOT_FROM_CAMERA,
    SIZE_M,
    LabDrive,
    TexturedLab,
    furnished,
    world_from_camera,
)
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import TexturedScene, cast

pytestmark = pytest.mark.slow

cv2 = pytest.importorskip("cv2")

CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
STEREO = RectifiedStereo(CAMERA, 0.12)
CLEAN = Imaging(noise_std=0.0, exposure_drift=0.0, lens_px=0.0, blur_s=0.0, vignetting=0.0, known=0)
TOUR = LabDrive().travelled()
SEEDS = range(3)
DRAWN = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in SEEDS[1:])]


@cache
def drawn(seed: int = 0, texel_m: float = 0.05, every: int = 400) -> TexturedScene:
    return TexturedLab(LabDrive(every=every), texel_m=texel_m).build(np.random.default_rng(seed))


@dataclass(frozen=True)
class Drawn:
    """A world of images that is drawn already, which takes most of the time."""

    scene: TexturedScene

    def build(self, rng: np.random.Generator) -> TexturedScene:
        return self.scene


@pytest.fixture(scope="module")
def near() -> TexturedScene:
    """Nine images of the beginning, finely painted."""
    return TexturedLab(LabDrive(frames=9, every=6), texel_m=0.015).build(np.random.default_rng(0))


def test_the_tour_is_as_long_as_that_of_the_paper() -> None:
    assert len(TOUR.way_m) == 4000
    assert 67.0 < TOUR.way_m[-1] < 68.5
    step = SE2.local(TOUR.world_from_robot[:-1], TOUR.world_from_robot[1:])
    assert np.abs(step[:, 2]).max() < 1e-4
    assert np.diff(TOUR.way_m).max() < 0.02 and np.abs(step[:, 0]).max() < np.deg2rad(1.5)


def test_the_tour_comes_back_to_places_in_the_same_and_the_opposite_direction() -> None:
    theta, x, y = TOUR.world_from_robot[::10].T
    near = np.hypot(x[:, None] - x, y[:, None] - y) < 0.05
    later = np.subtract.outer(np.arange(len(x)), np.arange(len(x))) > 60
    turned = np.cos(theta[:, None] - theta)
    again, back = ((near & later & (turned > 0.99)).sum(axis=1) > 0, (near & later & (turned < -0.99)).sum(axis=1) > 0)
    # Metres of the tour where the robot has been before, facing the same way and the opposite one.
    way = 10.0 * TOUR.way_m[-1] / 4000.0
    assert again.sum() * way > 8.0 and back.sum() * way > 8.0
    assert (x < PARTITION_M[0]).any() and (x > PARTITION_M[1]).mean() > 0.25


@pytest.mark.parametrize("trajectory", ["tour", "turn_back"])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_robot_touches_nothing(trajectory: str, seed: int) -> None:
    place = LabDrive(trajectory).travelled().world_from_robot[::5, 1:]  # type: ignore[arg-type]
    blocks = np.array(furnished(np.random.default_rng(seed)).blocks)
    low = blocks[blocks[:, 0, 2] < 1.5]
    gap = np.maximum(low[:, 0, :2] - place[:, None], place[:, None] - low[:, 1, :2]).clip(min=0.0)
    assert np.hypot(*np.moveaxis(gap, -1, 0)).min() > 0.6
    assert (place.min(axis=0) > 1.5).all() and (place.max(axis=0) < np.array(SIZE_M[:2]) - 1.5).all()
    in_the_wall = (place[:, 0] > PARTITION_M[0]) & (place[:, 0] < PARTITION_M[1])
    assert in_the_wall.any() == (trajectory == "tour")
    assert ((place[in_the_wall, 1] > DOOR_M[0] + 0.5) & (place[in_the_wall, 1] < DOOR_M[1] - 0.5)).all()
    assert LINTEL_M > 1.5


def test_turning_back_shows_what_was_seen_before() -> None:
    theta = LabDrive("turn_back").travelled().world_from_robot[:, 0]
    away = np.abs(theta) > np.deg2rad(139.9)
    edges = np.flatnonzero(np.diff(away.astype(int)))
    lasting = np.diff(edges)[::2] / RATE_HZ
    assert len(lasting) == 2 and (lasting >= 5.0).all() and (lasting < 6.0).all()
    assert (np.abs(theta[[0, 200, 330, 599]]) < 1e-9)[[0, 3]].all()
    # The view of 65 degrees has nothing in common with that before.
    assert np.rad2deg(np.abs(theta[away])).min() > 65.0


def test_the_camera_looks_ahead_from_the_height_of_the_robot() -> None:
    pose = world_from_camera(np.array([[0.5 * np.pi, 3.0, 4.0]]))[0]
    np.testing.assert_allclose(pose[4:], [3.0 - 0.06, 4.0 + 0.1, 1.0], atol=1e-12)
    ahead, right = SE3.transform(pose, [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]) - pose[4:]
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(right, [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("seed", DRAWN)
def test_the_renderer_sees_what_single_rays_see(seed: int) -> None:
    """Thousands of rectangles, most of them hidden: no tile may drop one that is seen."""
    scene = drawn(seed)
    renderer = Renderer(scene.rectangles, CAMERA, grid=1)
    px = np.random.default_rng(seed).uniform(0.0, 1.0, (400, 2)) * [319, 239]
    px = np.round(px)
    column, row = px.astype(int).T
    assert len(scene.rectangles) > 1500
    for pose in scene.world_from_camera[seed::3]:
        depth, seen = renderer.depth(pose)
        expected, rows = cast(scene.rectangles, pose, CAMERA.unproject(px))
        np.testing.assert_allclose(depth[row, column], expected, rtol=1e-12)
        # Where two boxes touch, two faces are at the same place.
        assert (seen[row, column] == rows).mean() > 0.99 and np.isfinite(expected).all()


@pytest.mark.parametrize("seed", DRAWN)
def test_the_twin_in_points_is_seen_as_the_images_are(seed: int) -> None:
    """A point measured in the world of points is what a ray hits in that of images; posters hang 1 cm before walls."""
    scene = drawn(seed)
    world = LabWorld(LabDrive(every=400), points=4000)
    measuring = Measuring(noise_px=1e-6, measurements=150, new_per_frame=150, known=0, dropout=0.0)
    log = simulate_features(world, measuring, STEREO, seed)
    assert log.truth is not None
    np.testing.assert_array_equal(log.truth.world_from_camera, scene.world_from_camera)
    for frame, pose in zip(log.frames, scene.world_from_camera, strict=True):
        points = np.array([log.truth.landmarks[name] for name in frame.landmarks.tolist()])
        local = SE3.inverse_transform(pose, points)
        depth, _ = cast(scene.rectangles, pose, CAMERA.unproject(frame.z[:, :2]))
        assert (np.abs(depth - local[:, 2]) < 0.03).mean() > 0.97
        np.testing.assert_allclose(STEREO.project(local), frame.z, atol=1e-4)
        assert len(points) > 15


@pytest.fixture(scope="module")
def rendered(near: TexturedScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab") / "lab"
    simulate_images(Drawn(near), CLEAN, STEREO, folder, 0)
    return folder


def warped(image: np.ndarray, pose: np.ndarray, other: np.ndarray, renderer: Renderer) -> tuple[np.ndarray, np.ndarray]:
    """An image taken at a pose as it would look from another, and a mask of where both see one and the same plane."""
    depth, rows = renderer.depth(other)
    px = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    ray = np.concatenate([CAMERA.unproject(px), np.ones((240, 320, 1))], axis=-1)
    local = SE3.inverse_transform(pose, SE3.transform(other, depth[..., None] * ray))
    there = CAMERA.project(local).astype(np.float32)
    expected = cv2.remap(renderer.depth(pose)[0].astype(np.float32), there, None, cv2.INTER_NEAREST)
    seen = CAMERA.visible(local, 5.0) & (np.abs(expected / local[..., 2] - 1.0) < 0.01)
    window = np.ones((15, 15), np.uint8)
    label = rows.astype(np.float32)
    flat = cv2.erode(label, window) == cv2.dilate(label, window)
    mask = cv2.erode((seen & flat).astype(np.uint8), window)
    return cv2.remap(image, there, None, cv2.INTER_CUBIC), mask


def shift_px(expected: np.ndarray, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(2,) by which the image is shifted, by least squares on all pixels of the mask: strong texture counts most."""
    down, across = np.gradient(expected)
    slope = np.stack([across[mask], down[mask]], axis=-1)
    shift, *_ = np.linalg.lstsq(-slope, (image - expected)[mask], rcond=None)
    return np.asarray(shift)


def test_texture_is_in_both_images_where_the_truth_says(rendered: Path, near: TexturedScene) -> None:
    """The left image, carried to the right one and to a later one by depth and poses from the files, fits as it is."""
    sequence = open_stereo(rendered)
    assert sequence.baseline_m == 0.12 and sequence.truth is not None
    frames = list(sequence.frames())
    left, right, later = (np.asarray(image, float) for image in (frames[0].image, frames[0].right, frames[8].image))
    renderer = Renderer(near.rectangles, CAMERA)
    first, last = sequence.truth.world_from_camera[[0, 8]]
    beside = SE3.compose(first, SE3.exp([0.0, 0.0, 0.0, 0.12, 0.0, 0.0]))
    assert np.linalg.norm(SE3.translation(last) - SE3.translation(first)) > 0.2
    # The later image is sharper than what is carried to it from farther away, which the measure takes for some shift.
    for image, pose, most in ((right, beside, 0.01), (later, last, 0.05)):
        expected, mask = warped(left, first, pose, renderer)
        assert mask.mean() > 0.1
        assert np.abs(shift_px(expected, image, mask > 0)).max() < most
        # The measure itself: half a pixel is told from none.
        half = cv2.warpAffine(image, np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]]), (320, 240), flags=cv2.INTER_CUBIC)
        assert abs(shift_px(expected, half, mask > 0)[0] - 0.5) < 0.15
        parts = [shift_px(expected, image, (mask > 0) & (np.indices(mask.shape)[1] // 64 == k)) for k in range(5)]
        assert np.abs(parts).max() < most + 0.02


def test_the_folder_holds_what_the_wheels_say(rendered: Path) -> None:
    odometry = read_wheel_odometry(rendered)
    sequence = open_images(rendered)
    assert sequence.truth is not None
    assert len(odometry.stamps_ns) == 49
    np.testing.assert_array_equal(odometry.stamps_ns[::6], sequence.stamps_ns)
    np.testing.assert_allclose(odometry.robot_from_camera, ROBOT_FROM_CAMERA)
    reckoned = odometry.world_from_camera(sequence.truth.world_from_camera[0])[::6]
    apart = np.linalg.norm(reckoned[:, 4:] - sequence.truth.world_from_camera[:, 4:], axis=1)
    assert 0.0 < apart[-1] < 0.08 * TOUR.way_m[48]


def test_images_can_be_jpeg(tmp_path: Path) -> None:
    camera = Pinhole(96, 72, 75.0, 75.0, 47.5, 35.5)
    scene = drawn()
    two = replace(scene, stamps_ns=scene.stamps_ns[:2], world_from_camera=scene.world_from_camera[:2], odometry=None)
    read = {}
    for quality in (0, 50, 95):
        imaging = Imaging(jpeg=quality, known=0, depth=True)
        simulate_images(Drawn(two), imaging, camera, tmp_path / str(quality), 0)
        folder = tmp_path / str(quality) / "mav0"
        suffix = ".jpg" if quality else ".png"
        assert {path.suffix for path in (folder / "cam0" / "data").iterdir()} == {suffix}
        assert {path.suffix for path in (folder / "depth0" / "data").iterdir()} == {".png"}
        read[quality] = open_images(tmp_path / str(quality))
    exact, poor, good = (next(read[quality].frames()).image.astype(float) for quality in (0, 50, 95))
    assert 0.0 < np.abs(good - exact).mean() < 0.5 * np.abs(poor - exact).mean() < 5.0
