"""Short image sequences for the tests of `rbpf run mono`."""

import shutil
from pathlib import Path

from rbpf.sensors.pinhole import Pinhole
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk

CAMERA = Pinhole(240, 180, 190.0, 190.0, 119.5, 89.5)
FRAMES = 16


def render_desk(folder: Path) -> Path:
    """A desk, EuRoC ASL."""
    simulate_images(
        TexturedDesk(frames=FRAMES, texel_m=0.003), Imaging(noise_std=1.0), CAMERA, folder, seed=1
    )
    return folder


def as_folder(desk: Path, folder: Path) -> Path:
    """The desk's images as a plain folder with times, so that a test can spoil single files."""
    (folder / "images").mkdir(parents=True)
    images = sorted((desk / "mav0" / "cam0" / "data").iterdir())
    for number, path in enumerate(images):
        shutil.copy(path, folder / "images" / f"{number:06d}.png")
    shutil.copy(desk / "camera.yaml", folder / "camera.yaml")
    (folder / "times.txt").write_text("".join(f"{number / 30:.6f}\n" for number in range(len(images))))
    return folder
