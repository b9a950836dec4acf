"""What simulated worlds keep: refusals, examples that run, bytes that follow the seed alone, folders that are recordings."""

import csv
import doctest
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from examples.studies import point_worlds
from examples.studies.lab import LabDrive, TexturedLab
from examples.studies.point_worlds import DeskWorld, Measuring
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import open_images, open_stereo
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.validation.simulation import images, textured_scene
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.laser import LaserWorld, WheelOdometer
from rbpf.validation.simulation.paths import HandHeld
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.robot import RobotWorld
from rbpf.validation.simulation.textured_scene import ImageWorld, Rectangle, TexturedScene, stamps_ns

GREY = np.full((8, 8), 128, dtype=np.uint8)
SQUARE = {"corner": np.zeros(3), "across": np.eye(3)[0], "down": np.eye(3)[1], "texture": GREY}
SMALL = RectifiedStereo(Pinhole(96, 72, 75.0, 75.0, 47.5, 35.5), 0.12)


def sheet(**wrong: Any) -> Rectangle:
    return Rectangle(**{**SQUARE, **wrong})


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (DeskWorld, {"frames": 1}, "frames must be a whole number, at least 2"),
        (HandHeld, {"speed_m_s": -1.0}, "speed_m_s must be above 0 .*, got -1.0"),
        (Measuring, {"outlier_rate": 1.0}, "outlier_rate must be at least 0 and below 1, got 1.0"),
        (HandHeld, {"elevation_deg": 85.0}, "elevation_deg must be .* below 80"),
        (LabDrive, {"trajectory": "walk"}, "trajectory must be 'tour' or 'turn_back', got 'walk'"),
        (LabDrive, {"frames": 4001}, "has 4000 images"),
        (WheelOdometer, {"inequality": 0.6}, "inequality must be above -0.5 and below 0.5"),
        (LaserWorld, {"dropouts": 1.0}, "dropouts must be at least 0 and below 1, got 1.0"),
        (RobotWorld, {"std_range_m": 0.0}, "std_range_m must be above 0"),
        (Imaging, {"blackout": (0,)}, "blackout names frame 0"),
        (sheet, {"corner": np.array([0.0, np.nan, 0.0])}, "finite"),
        (sheet, {"texture": GREY[:1]}, "at least 2 x 2"),
    ],
)
def test_what_makes_no_sense_is_refused(kind: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        kind(**options)


@pytest.mark.parametrize("module", [images, point_worlds, textured_scene])
def test_examples_in_the_docstrings_run(module: ModuleType) -> None:
    result = doctest.testmod(module)
    assert result.attempted > 0 and result.failed == 0


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "imaging"),
    [
        (TexturedDesk(frames=3, texel_m=0.02), Imaging(exposure_drift=0.2, blur_s=0.05, known=4)),
        (TexturedRoom(frames=3, texel_m=0.05), Imaging(vignetting=0.3, known=4)),
        (TexturedLab(LabDrive("turn_back", 4, every=30), texel_m=0.5), Imaging(jpeg=90, known=0)),
    ],
    ids=["desk", "room", "lab"],
)
def test_a_seed_gives_the_same_files(world: ImageWorld, imaging: Imaging, tmp_path: Path) -> None:
    for name, seed in {"first": 3, "again": 3, "other": 4}.items():
        simulate_images(world, imaging, SMALL, tmp_path / name, seed)
    first, again, other = (contents(tmp_path / name) for name in ("first", "again", "other"))
    assert first == again
    assert first.keys() == other.keys()
    drawn = {name for name in first if name.endswith((".png", ".jpg"))}
    drawn |= {"known_points.csv", "odometry.csv"} & first.keys()
    assert len(drawn) >= 7 and not any(first[name] == other[name] for name in drawn)


cv2 = pytest.importorskip("cv2")

CAMERA = Pinhole(160, 120, 110.0, 110.0, 79.5, 59.5)
STEREO = RectifiedStereo(CAMERA, 0.1)
BENT = replace(CAMERA, distortion=(-0.1, 0.02, 1e-3, 0.0, 0.0))
WIDE = replace(BENT, fx=66.0, fy=66.0, distortion=(-0.03, 0.02, -0.012, 0.002), distortion_model="equidistant")
CLEAN = Imaging(noise_std=0.0, exposure_drift=0.0, lens_px=0.0, blur_s=0.0, vignetting=0.0, known=0)
DESK = TexturedDesk(frames=4, texel_m=0.008)
ROOM = TexturedRoom(frames=4, texel_m=0.02)


def pictures(folder: Path, sensor: str = "cam0") -> np.ndarray:
    paths = sorted((folder / "mav0" / sensor / "data").iterdir())
    return np.array([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths])


def states(folder: Path) -> np.ndarray:
    """(T, 17) strings."""
    with open(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", encoding="utf-8") as file:
        return np.array(list(csv.reader(file))[1:])


def truth(folder: Path) -> np.ndarray:
    """(T, 7) poses."""
    return states(folder)[:, [5, 6, 7, 4, 1, 2, 3]].astype(float)


@pytest.mark.slow
def test_the_folder_is_read_as_an_euroc_sequence(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    folder = tmp_path / "deep" / "desk"
    simulate_images(DESK, Imaging(depth=True), STEREO, folder, 0, lambda *args: told.append(args))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    sequence = open_stereo(folder)
    assert sequence.rig == STEREO
    np.testing.assert_array_equal(sequence.stamps_ns, stamps_ns(4, 30.0))
    np.testing.assert_array_equal([frame.image for frame in sequence.frames()], pictures(folder))
    np.testing.assert_array_equal([frame.right for frame in sequence.frames()], pictures(folder, "cam1"))
    poses = DESK.build(np.random.default_rng(0)).world_from_camera
    np.testing.assert_allclose(truth(folder), poses, atol=1e-11)
    velocity = (poses[2, 4:] - poses[0, 4:]) / (sequence.stamps_ns[2] - sequence.stamps_ns[0]) * 1e9
    np.testing.assert_allclose(states(folder)[1, 8:11].astype(float), velocity, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("lens", [BENT, WIDE], ids=["distorted", "fisheye"])
def test_two_cameras_that_distort_are_read_as_a_rectified_pair(lens: Pinhole, tmp_path: Path) -> None:
    simulate_images(ROOM, CLEAN, lens, tmp_path / "room", 0, baseline_m=0.1)
    assert open_images(tmp_path / "room").camera == lens
    assert read_calibration(tmp_path / "room" / "camera.yaml").camera == lens
    sequence = open_stereo(tmp_path / "room")
    assert sequence.rig.baseline_m == pytest.approx(0.1, rel=1e-9)
    if lens is WIDE:
        assert sequence.rig.camera == Pinhole(160, 120, 66.0, 66.0, 79.5, 59.5)
    scene = ROOM.build(np.random.default_rng(0))
    renderer = Renderer(scene.rectangles, sequence.rig.camera)
    for frame, pose in zip(sequence.frames(), scene.world_from_camera, strict=True):
        right = SE3.compose(pose, SE3.exp([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]))
        for image, view in ((frame.image, pose), (frame.right, right)):
            expected = renderer.image(view)
            alike = [np.corrcoef(image.ravel(), np.roll(expected, k, 1).ravel())[0, 1] for k in (-1, 0, 1)]
            assert alike[1] > 0.95 and alike[1] > max(alike[0], alike[2]) + 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("world", "std_m"), [(DESK, 1e-6), (ROOM, 0.02)])
def test_known_points_are_corners_seen_in_the_first_image(world: ImageWorld, std_m: float, tmp_path: Path) -> None:
    imaging = Imaging(known=8, known_std_m=std_m, noise_std=1.0, depth=True)
    simulate_images(world, imaging, BENT, tmp_path / "run", 1)
    table = np.genfromtxt(tmp_path / "run" / "known_points.csv", delimiter=",", names=True)
    px = np.stack([table["u_px"], table["v_px"]], axis=-1)
    position = np.stack([table["x_m"], table["y_m"], table["z_m"]], axis=-1)
    first, *_, last = truth(tmp_path / "run")
    local = SE3.inverse_transform(first, position)
    error = BENT.project(local) - px
    assert table["id"].tolist() == list(range(1, 9)) and (table["sigma_m"] == std_m).all()
    if std_m < 0.02:
        assert np.abs(error).max() < 1e-3
        depth = pictures(tmp_path / "run", "depth0")[0] / 5000.0
        for (column, row), point in zip(px.astype(int), local, strict=True):
            assert abs(depth[row, column] - point[2]) < 2e-4
            window = depth[row - 3 : row + 4, column - 3 : column + 4]
            assert window.max() < 1.15 * window.min()
    else:
        score = error / (0.02 * BENT.fx / local[:, 2:])
        assert 0.3 < score.std() < 2.0
    image = pictures(tmp_path / "run")[0].astype(np.float32)
    quality = cv2.cornerMinEigenVal(image, 5)
    u, v = np.round(px).astype(int).T
    assert (quality[v, u] > np.median(quality)).all()
    assert (np.ptp(px[:4], axis=0) > [50.0, 35.0]).all()
    apart = np.linalg.norm(px[:, None] - px, axis=-1)
    assert (apart[~np.eye(8, dtype=bool)] > 10.0).all()
    assert BENT.visible(SE3.inverse_transform(last, position), margin_px=5.0).all()


@pytest.mark.slow
def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    (tmp_path / "run").mkdir()
    with pytest.raises(KeyboardInterrupt):
        simulate_images(DESK, Imaging(), CAMERA, tmp_path / "run", 0, stop)
    assert list(tmp_path.rglob("*")) == [tmp_path / "run"]
    simulate_images(DESK, Imaging(), CAMERA, tmp_path / "run", 0)
    assert len(pictures(tmp_path / "run")) == 4
    assert not (tmp_path / "run.partial").exists()


def test_a_folder_with_files_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        simulate_images(DESK, Imaging(), CAMERA, tmp_path, 0)
    assert contents(tmp_path) == {"notes.txt": b"mine"}
    with pytest.raises(InputError, match=r"cannot make the folder .* for the images"):
        simulate_images(DESK, Imaging(), CAMERA, tmp_path / "notes.txt" / "run", 0)


class GreyWall:
    """An evenly grey wall with a bright right half; the camera turns by 10 mrad a frame, at 10 frames a second."""

    def __init__(self, frames: int = 3) -> None:
        self.frames = frames

    def build(self, rng: np.random.Generator) -> TexturedScene:
        halves = [np.full((4, 4), grey, dtype=np.uint8) for grey in (60, 180)]
        sheets = [
            Rectangle(np.array([left, -9.0, 1.0]), np.array([9.0, 0, 0]), np.array([0, 18.0, 0]), texture)
            for left, texture in zip((-9.0, 0.0), halves, strict=True)
        ]
        turn = np.zeros((self.frames, 6))
        turn[:, 1] = 0.01 * np.arange(self.frames)
        return TexturedScene("wall", stamps_ns(self.frames, 10.0), SE3.exp(turn), sheets)


def test_noise_has_the_stated_strength(tmp_path: Path) -> None:
    simulate_images(GreyWall(), replace(CLEAN, noise_std=3.0), CAMERA, tmp_path / "run", 0)
    dark = pictures(tmp_path / "run")[:, 5:115, 5:60].astype(float)
    n = dark.size
    assert abs(dark.mean() - 60.0) < 5.0 * 3.0 / np.sqrt(n)
    # Rounding to whole grey levels adds 1/12.
    assert abs(dark.var() - 9.0 - 1.0 / 12.0) < 5.0 * 9.0 * np.sqrt(2.0 / n)
    first, second = dark[0] - 60.0, dark[1] - 60.0
    assert abs((first * second).mean()) < 5.0 * 9.0 / np.sqrt(first.size)


def test_blackout_vignetting_and_exposure(tmp_path: Path) -> None:
    simulate_images(GreyWall(30), replace(CLEAN, blackout=range(4, 6)), CAMERA, tmp_path / "dark", 0)
    lit = pictures(tmp_path / "dark").any(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(~lit), [4, 5])
    simulate_images(GreyWall(), replace(CLEAN, vignetting=0.4), CAMERA, tmp_path / "vignette", 0)
    image = pictures(tmp_path / "vignette")[0]
    assert image[0, 0] == round(0.6 * 60) and image[60, 79] in (60, 120, 180)
    simulate_images(GreyWall(30), replace(CLEAN, exposure_drift=0.3), CAMERA, tmp_path / "drift", 0)
    gain = pictures(tmp_path / "drift")[:, 60, 5] / 60.0
    assert np.ptp(gain) > 0.05
    assert (np.abs(gain - 1.0) <= 0.31).all()
    assert np.abs(np.diff(gain)).max() < 0.15


def test_blur_spreads_an_edge_evenly_about_where_it_is_at_the_stamp(tmp_path: Path) -> None:
    """The camera turns by 0.1 rad/s: with the shutter open for 0.8 s the edge moves 8.8 px."""
    simulate_images(GreyWall(), replace(CLEAN, blur_s=0.8), CAMERA, tmp_path / "run", 0)
    row = pictures(tmp_path / "run")[0, 60].astype(float)
    ramp = (row - 60.0) / 120.0
    expected = np.clip((np.arange(160.0) - 79.5) / (0.08 * 110.0) + 0.5, 0.0, 1.0)
    np.testing.assert_allclose(ramp, expected, atol=0.08)
    assert abs((ramp - expected).sum()) < 0.15


def test_a_lens_spreads_an_edge_by_its_point_spread(tmp_path: Path) -> None:
    simulate_images(GreyWall(), replace(CLEAN, lens_px=1.5), CAMERA, tmp_path / "run", 0)
    line = np.diff(pictures(tmp_path / "run")[0, 60].astype(float)) / 120.0
    middle = (line * np.arange(159)).sum()
    spread = (line * (np.arange(159) - middle) ** 2).sum()
    assert abs(middle - 79.0) < 0.05
    assert abs(np.sqrt(spread) - 1.5) < 0.15


def test_what_cannot_be_done_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="frame 9"):
        simulate_images(TexturedDesk(frames=4, texel_m=0.01), Imaging(blackout=(9,)), CAMERA, tmp_path / "run", 0)
    with pytest.raises(InputError, match="corners that can be known"):
        simulate_images(GreyWall(), Imaging(), CAMERA, tmp_path / "run", 0)
    assert not any(tmp_path.iterdir())
