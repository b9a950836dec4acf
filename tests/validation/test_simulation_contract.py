"""What every simulated world and option keeps: refusals in words, examples that run, bytes that follow the seed alone."""

import doctest
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from examples.studies import point_worlds
from examples.studies.point_worlds import DeskWorld, Measuring
from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation import images, textured_scene
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.lab import LabDrive, TexturedLab
from rbpf.validation.simulation.laser import LaserWorld
from rbpf.validation.simulation.paths import HandHeld, WheelOdometer
from rbpf.validation.simulation.robot import RobotWorld
from rbpf.validation.simulation.textured_scene import ImageWorld, Rectangle

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
