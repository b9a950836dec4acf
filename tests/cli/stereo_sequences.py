"""A short stereo sequence for the tests of `rbpf run stereo`."""

from pathlib import Path

from rbpf.cli import main
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.desk_and_room import TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images

RIG = RectifiedStereo(Pinhole(320, 240, 220.0, 220.0, 159.5, 119.5), 0.12)
FRAMES = 8


def render_room(folder: Path) -> Path:
    """A room, EuRoC ASL."""
    world = TexturedRoom(frames=FRAMES, rate_hz=5.0)
    simulate_images(world, Imaging(known=0, noise_std=1.0), RIG, folder, seed=1)
    return folder


def run(sequence: Path, out: Path, *arguments: str) -> int:
    return main(["run", "stereo", str(sequence), "--particles", "50", "--out", str(out), *arguments])
