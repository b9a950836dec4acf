"""Short image sequences for the tests of `rbpf run mono` and `rbpf run stereo`, and a disk that is full."""

import json
import resource
import shutil
import sys
from contextlib import contextmanager
from pathlib import Path

from rbpf.cli import main
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images

CAMERA = Pinhole(240, 180, 190.0, 190.0, 119.5, 89.5)
FRAMES = 16
RIG = RectifiedStereo(Pinhole(320, 240, 220.0, 220.0, 159.5, 119.5), 0.12)
PAIRS = 8


def render_desk(folder: Path) -> Path:
    """A desk, EuRoC ASL."""
    simulate_images(TexturedDesk(frames=FRAMES, texel_m=0.003), Imaging(noise_std=1.0), CAMERA, folder, seed=1)
    return folder


def render_room(folder: Path) -> Path:
    """A room seen by two cameras, EuRoC ASL."""
    world = TexturedRoom(frames=PAIRS, rate_hz=5.0)
    simulate_images(world, Imaging(known=0, noise_std=1.0), RIG, folder, seed=1)
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


def run(sequence, out, *arguments, known=True, video=False):
    points = Path(sequence) / "known_points.csv"
    given = ["--known-points", str(points)] if known and points.exists() else []
    shown = [] if "--video" in arguments else ["--no-video"]
    shown += [] if {"--video", "--batch"} & set(arguments) else ["--no-batch"]
    return main(["run", "mono", str(sequence), *given, "--out", str(out), "--particles", "8", *shown, *arguments])


def run_stereo(sequence: Path, out: Path, *arguments: str) -> int:
    return main(["run", "stereo", str(sequence), "--particles", "50", "--out", str(out), *arguments])


def summary(out):
    return json.loads((out / "summary.json").read_text())


def sentence(capsys):
    """What was said last, which must be one line."""
    error = capsys.readouterr().err
    assert "Traceback" not in error
    said = error[error.index("rbpf: ") :]
    assert said.count("\n") == 1
    return said


def refused(capsys, sequence, out, *arguments):
    """The one sentence with which a run is refused."""
    assert run(sequence, out, *map(str, arguments)) == 2
    assert not (out / "summary.json").exists()
    return sentence(capsys)


@contextmanager
def full_disk(most_bytes):
    """No file grows beyond so many bytes: what writes more gets an error, as on a full disk."""
    before, bytecode = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # Python does not notice that what it compiles is cut off
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = bytecode
