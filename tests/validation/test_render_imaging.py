"""What a simulated camera does to its pictures: depth, stereo, noise, exposure, vignetting, blur."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.textured_scene import Rectangle, TexturedScene, stamps_ns

cv2 = pytest.importorskip("cv2")

CAMERA = Pinhole(160, 120, 110.0, 110.0, 79.5, 59.5)
STEREO = RectifiedStereo(CAMERA, 0.1)
CLEAN = Imaging(noise_std=0.0, exposure_drift=0.0, lens_px=0.0, blur_s=0.0, vignetting=0.0, known=0)


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


def pictures(folder: Path, sensor: str = "cam0") -> np.ndarray:
    paths = sorted((folder / "mav0" / sensor / "data").iterdir())
    return np.array([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths])


def test_depth_images_hold_the_depth(tmp_path: Path) -> None:
    simulate_images(GreyWall(), replace(CLEAN, depth=True), CAMERA, tmp_path / "run", 0)
    depth = pictures(tmp_path / "run", "depth0")
    assert depth.dtype == np.uint16
    assert (depth[0] == 5000).all()


def test_the_right_image_is_seen_from_the_baseline(tmp_path: Path) -> None:
    simulate_images(GreyWall(), CLEAN, STEREO, tmp_path / "run", 0)
    left, right = (pictures(tmp_path / "run", sensor)[0] for sensor in ("cam0", "cam1"))
    np.testing.assert_array_equal(right[:, :-11], left[:, 11:])


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
