"""`rbpf calibrate` and `rbpf recalibrate`: the camera from pictures of a chessboard, or from what a run measured."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rbpf.cli.options import Printed
from rbpf.cli.showing import answer, progress, say
from rbpf.ranges import Positive

#: Standard deviation of focal lengths and centre, as a fraction of the focal length, beyond which a run's path is deformed.
LOOSE = 0.01


@dataclass(frozen=True, kw_only=True)
class Calibrate(Printed):
    """Estimate a camera's focal lengths, principal point and distortion from images of a chessboard; write camera.yaml."""

    #: folder of images of the board, 15 or more from different directions, or a video of it.
    images: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    board: str  #: inner corners (columns x rows) of the chessboard, where four squares meet, such as 9x6.
    square: Positive  #: side of its squares, m.
    #: camera model; fisheye is an equidistant lens, for fields of view of about 110 degrees or more.
    model: Literal["pinhole", "fisheye"] = "pinhole"
    out: Path = Path("calibration")  #: folder for camera.yaml, calibration.png and calibration.json.

    def __call__(self) -> None:
        from rbpf.sensors.calibration import Board
        from rbpf.validation.calibration import PICTURE, calibrate_images, write_calibration

        board = Board.parse(self.board, self.square)
        with progress() as bar:
            found, looked_at = calibrate_images(self.images, board, bar("looking for the board"), self.model)
        entries = write_calibration(found, board, looked_at, self.out)
        camera, std = found.camera, found.std
        left_out = f", {len(found.left_out)} left out" if found.left_out else ""
        answer(
            entries | {"out": str(self.out)},
            self.json,
            f"{len(found.views)} views of {looked_at} images{left_out}; reprojection error {found.rms_px:.3f} px; "
            f"corners in {100 * found.covered:.0f} % of the image",
            f"fx {camera.fx:.2f} ± {std[0]:.2f}, fy {camera.fy:.2f} ± {std[1]:.2f}, cx {camera.cx:.2f} ± {std[2]:.2f}, "
            f"cy {camera.cy:.2f} ± {std[3]:.2f} px",
            f"camera.yaml and {PICTURE} are in {self.out}; use it with --calibration {self.out / 'camera.yaml'}",
        )
        if self.json:
            return
        if found.covered < 0.5:
            say("the board was seen in less than half of the image: distortion is uncertain where it was not")
        loose = float(max(std[:4])) / camera.fx
        if loose > LOOSE:
            say(
                f"the camera is known to {100 * loose:.1f} % of its focal length only, and a run with it will bend: film "
                "the board larger, and tilted in all directions"
            )


@dataclass(frozen=True, kw_only=True)
class Recalibrate(Printed):
    """Estimate focal length and k1 from a run's own measurements, and write camera.yaml: for nominal calibrations."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder of a finished monocular run.
    out: Path = Path("recalibration")  #: folder for camera.yaml.

    def __call__(self) -> None:
        from rbpf.validation.gtsam.self_calibration import recalibrate as from_run

        with progress() as bar:
            entries, found = from_run(self.run, self.out, bar("adjusting the camera with poses and landmarks"))
        focal, k1 = entries["fx"], entries["k1"]
        answer(
            entries | {"out": str(self.out)},
            self.json,
            f"focal length {focal['before']:.2f} → {focal['after']:.2f} px (± {found.std[0] * focal['after']:.2f}), "
            f"k1 {k1['before']:.4f} → {k1['after']:.4f} (± {found.std[1]:.4f}); "
            f"half the squared misfit {entries['error_before']:.0f} → {entries['error_after']:.0f}",
            f"camera.yaml is in {self.out}; use it with --calibration {self.out / 'camera.yaml'}",
        )
