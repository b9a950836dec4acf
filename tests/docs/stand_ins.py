"""What the tests put in place of what a reader has: small recordings, and shorter forms of long commands.

Nothing else is changed: every command runs with the words that stand on the page, in a folder in which its
recordings exist under the names that the page uses.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

from rbpf.cli import main
from rbpf.sensors.readers import ImageSequence, open_images, open_stereo
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.laser import LaserWorld, simulate_laser
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from tests.cli.sequences import CAMERA as DESK_CAMERA
from tests.cli.sequences import render_desk, render_room
from tests.readers.images.bags import film_images, film_pairs, recorded
from tests.sensors.board_pictures import CAMERA, FISHEYE, pictures

SHORTER = {
    ("simulate", "range-bearing"): ["--steps", "20", "--landmarks", "20"],
    ("simulate", "laser"): ["--scans", "20", "--laps", "1"],
    ("simulate", "desk"): ["--frames", "8", "--width", "480", "--height", "360"],
    ("simulate", "room"): ["--frames", "4", "--width", "160", "--height", "120"],
}
"""Added to a command that would render or simulate for minutes."""

FEW = {
    ("run", "mono"): ["--particles=10", "--no-batch", "--no-video"],
    ("run", "stereo"): ["--particles=50", "--no-batch", "--no-video"],
    ("run", "range-bearing"): ["--particles=20", "--no-batch"],
}
WHOLE = {"README.md", "docs/how_to/compare.md"}
"""Added on all pages but these, which show what a run leaves, or use it: tests/cli has runs with everything."""

LEFT_OUT = {("sweep",): "--scheduler"}
"""An option with its value: tests/validation/test_sweep.py starts a cluster."""

NAMES = {
    **{name: name for name in ("log", "robot.clf", "phone.mp4", "board.mp4", "drive.bag", "stereo.bag", "wide.mp4")},
    **dict.fromkeys(
        ("IMAGES", "SEQUENCE", "DATA/mono_redkitchen_a", "DATA/stereo_zed_room1", "DATA/mono_robot_lateral"), "desk"
    ),
    "PAIRS": "pairs",
    "LOG": "log",
}
"""Names on the pages, and the recordings of `Shelf` that they stand for."""

NAMES_OF_PAGE = {
    "docs/phone_video.md": {"phone.mp4": "walk.mp4"},
    "docs/how_to/known_points.md": {"IMAGES": "longer"},
    "docs/how_to/live.md": {"camera.mp4": "camera.mp4"},
    "docs/how_to/stereo.md": {"SEQUENCE": "pairs", "path/to/sequence": "pairs"},
    "docs/how_to/stereo_confidence.md": {"SEQUENCE": "pairs"},
    "docs/how_to/stereo_features.md": {"path/to/sequence": "pairs"},
    "docs/how_to/sweep.md": {"other_log": "log"},
}

BEFORE = {
    "docs/how_to/after_the_run.md": [["run", "range-bearing", "log", "--out", "run", "--no-batch"]],
    "docs/how_to/report.md": [
        ["run", "range-bearing", "log", "--out", "RUN", "--no-batch"],
        ["run", "range-bearing", "log", "--out", "OTHER", "--no-batch", "--seed", "1"],
    ],
    "docs/how_to/compare.md": [
        ["run", "mono", "desk", "--known-points", "desk/known_points.csv", "--out", "out/mono", "--no-video"]
    ],
}
"""Commands that a page takes as done."""

PREAMBLE = {
    "docs/how_to/sensor.md": """
from examples.custom_sensor import LampSensor
from examples.gps_imu import *
from rbpf.core.models import Records
from rbpf.motion.odometry import OdometryMotion

filter_ = Filter(OdometryMotion(SE2), Receiver(), n=20, rng=np.random.default_rng(0))
fix = np.array([0.1, 0.2])
filter_.step(fix)
state = np.zeros((20, 3))
records = Records(np.tile([3.0, 1.0], (20, 2, 1)), np.tile(0.01 * np.eye(2), (20, 2, 1, 1)))
""",
    "docs/how_to/rates.md": "from examples.gps_imu import Position\n",
}
"""Names that a page's programs take from the examples that the page shows."""


class Shelf:
    """Small recordings, each made when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        long_enough = TexturedDesk(frames=80, texel_m=0.003)  # for a map in which a camera can be found
        self.makers: dict[str, Callable[[Path], object]] = {
            "desk": render_desk,
            "longer": partial(simulate_images, long_enough, Imaging(jpeg=90), DESK_CAMERA, seed=3),
            "log": partial(simulate_robot, RobotWorld(steps=20, landmarks=20), seed=0),
            "robot.clf": self._robot,
            "pairs": render_room,
            "phone.mp4": lambda path: _film(_images(self.get("desk")), path),
            "camera.mp4": self._camera,
            "board.mp4": lambda path: _film(_coloured(pictures()), path),
            "drive.bag": lambda path: _bagged(path, film_images, open_images(self.get("desk"))),
            "stereo.bag": lambda path: _bagged(path, film_pairs, open_stereo(self.get("pairs"))),
            "wide.mp4": lambda path: _film(_coloured(pictures(10, FISHEYE)), path),
            "walk.mp4": self._walk,
        }

    def get(self, name: str) -> Path:
        """Folder or file of a recording."""
        path = self.folder / name
        if not path.exists():
            self.makers[name](path)
        return path

    def _robot(self, path: Path) -> None:
        simulate_laser(LaserWorld(scans=20, laps=1), self.folder / "corridor", seed=0)
        shutil.copy(self.folder / "corridor" / "robot.clf", path)

    def _camera(self, path: Path) -> None:
        """The desk's images, with the camera that took them."""
        _film(_images(self.get("desk")), path)
        shutil.copy(self.get("desk") / "camera.yaml", path.with_suffix(".yaml"))

    def _walk(self, path: Path) -> None:
        """The camera that took the board's pictures, over a desk on which the board lies."""
        folder = self.folder / "walked"
        world = TexturedDesk(frames=8, texel_m=0.003, board=(10, 7), square_m=0.024)
        simulate_images(world, Imaging(noise_std=1.0), CAMERA, folder, seed=1)
        _film(_images(folder), path)


def lay_out(page: str, shelf: Shelf, folder: Path) -> None:
    """The folder in which a page's commands run: every recording that it names, under that name."""
    text = (Path(__file__).resolve().parents[2] / page).read_text(encoding="utf-8")
    for name, recording in (NAMES | NAMES_OF_PAGE.get(page, {})).items():
        if name in text:
            place(shelf.get(recording), folder / name)
    if "make demo" in text:  # which renders a desk only where there is none
        place(shelf.get("desk"), folder / "demo" / "desk")
    for command in BEFORE.get(page, []):
        for word in command:
            if word in ("desk", "pairs", "log"):
                place(shelf.get(word), folder / word)
        assert main(command) == 0


def place(recording: Path, name: Path) -> None:
    """A copy, so that what a page does to it stays on the page."""
    if name.exists():
        return
    name.parent.mkdir(parents=True, exist_ok=True)
    if recording.is_dir():
        shutil.copytree(recording, name)
    else:
        shutil.copy(recording, name)
        calibration = recording.with_suffix(".yaml")
        if calibration.exists():
            shutil.copy(calibration, name.with_suffix(".yaml"))


def shortened(arguments: list[str], page: str = "") -> list[str]:
    """The words of an `rbpf` command on a page, with what makes it short."""
    for start, option in LEFT_OUT.items():
        if tuple(arguments[: len(start)]) == start and option in arguments:
            at = arguments.index(option)
            arguments = arguments[:at] + arguments[at + 2 :]
    given = {word.partition("=")[0] for word in arguments}
    for shorter, as_given in ((SHORTER, set[str]()), ({} if page in WHOLE else FEW, given)):
        for start, more in shorter.items():
            if tuple(arguments[: len(start)]) == start:
                arguments = arguments + [word for word in more if word.partition("=")[0] not in as_given]
    return arguments


def _bagged(path: Path, film: Callable[..., object], sequence: ImageSequence) -> None:
    with recorded(path) as bag:
        film(bag, sequence)


def _coloured(grey: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [np.repeat(image[..., None], 3, axis=-1) for image in grey]


def _images(sequence: Path) -> list[np.ndarray]:
    """Those of a rendered sequence, in colour."""
    paths = sorted((sequence / "mav0" / "cam0" / "data").glob("*.png"))
    return [np.ascontiguousarray(cv2.imread(os.fspath(path))[..., ::-1]) for path in paths]


def _film(frames: Sequence[np.ndarray], path: Path) -> None:
    """The images as a video of 30 frames per second."""
    height, width = frames[0].shape[:2]
    writer = imageio_ffmpeg.write_frames(os.fspath(path), (width, height), fps=30, quality=9, macro_block_size=1)
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
