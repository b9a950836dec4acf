"""`rbpf simulate`: logs and images of simulated worlds, with ground truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from rbpf.cli.commands import Commands
from rbpf.cli.compiling import compile_kernels
from rbpf.cli.options import MOST_PX, Flag, Printed, Real, RealPositive, Text, given_board
from rbpf.cli.showing import answer, progress
from rbpf.errors import InputError
from rbpf.ranges import MOST, Count, CountOrNone, Fraction, NotNegative, Range, Seed

if TYPE_CHECKING:
    from rbpf.validation.simulation.textured_scene import ImageWorld


@dataclass(frozen=True, kw_only=True)
class SimulateRangeBearing(Printed):
    """A log of a robot among landmarks, with ground truth."""

    out: Path  #: folder for the log.
    seed: Seed = 0  #: seed of the random generator.
    spatial: Flag = False  #: six degrees of freedom instead of three.
    steps: Annotated[int, Range(ge=2, le=MOST)] = 200  #: number of steps, one a second.
    landmarks: Count = 60  #: number of landmarks.
    unnamed: Flag = False  #: the log has no landmark names (unknown association).

    def __call__(self) -> None:
        from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

        world = RobotWorld(self.steps, self.landmarks, self.spatial, unnamed=self.unnamed)
        simulate_robot(world, self.out, self.seed)
        answer({"out": str(self.out), "steps": self.steps}, self.json, f"wrote {self.out}")


@dataclass(frozen=True, kw_only=True)
class SimulateLaser(Printed):
    """A log of a robot with a laser scanner that drives round a closed corridor, with ground truth."""

    out: Path  #: folder for the log robot.clf, the true path truth.tum, and robot.relations.
    seed: Seed = 0  #: seed of the random generator.
    scans: Annotated[int, Range(ge=2, le=MOST)] = 400  #: number of scans.
    laps: Annotated[int, Range(ge=1, le=1000)] = 2  #: number of laps.

    def __call__(self) -> None:
        from rbpf.validation.simulation.laser import LaserWorld, simulate_laser

        simulate_laser(LaserWorld(self.scans, self.laps), self.out, self.seed)
        answer({"out": str(self.out), "scans": self.scans}, self.json, f"wrote {self.out}")


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Printed):
    """Options of every `rbpf simulate` that renders images."""

    focal_fraction: ClassVar[float]  #: focal length by default, as a fraction of the width.
    #: folder for the sequence (EuRoC ASL, with camera.yaml and known_points.csv); must not exist, or be empty.
    out: Path
    seed: Seed = 0  #: seed of the random generator.
    width: Annotated[int, Range(ge=2, le=MOST_PX)] = 640  #: width of the images, px.
    height: Annotated[int, Range(ge=2, le=MOST_PX)] = 480  #: height of the images, px.
    focal_px: RealPositive = None  #: focal length, px; by default a fraction of the width.
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  #: k1, k2, p1, p2, k3.
    #: instead, k1, k2, k3, k4 of an equidistant lens; by default none. The ideal one has 0 0 0 0; its field of view is 140
    #: degrees for a focal length of 0.41 of the width.
    fisheye: tuple[float, float, float, float] | None = None
    baseline_m: Real = None  #: baseline to a second camera on the right, m; by default none.
    known: CountOrNone = 6  #: number of known points, corners in the first image, at least 4; 0 for none.
    noise_std: NotNegative = 3.0  #: standard deviation of the sensor noise, grey levels.
    blur_s: NotNegative = 0.01  #: exposure time, s.
    exposure_drift: Fraction = 0.15  #: largest relative change of the exposure.
    vignetting: Fraction = 0.2  #: relative loss of light in the corners.
    contrast: NotNegative = 1.0  #: contrast of all textures; 1 is rich, 0.1 poor.
    #: first dark frame and number of dark frames; by default none.
    blackout: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="INT INT", help_behavior_hint="")] = None
    depth: Flag = False  #: also write depth images.
    #: quality of JPEG files, 1 to 100; 0 writes lossless PNG.
    jpeg: Annotated[int, Range(ge=0, le=100)] = 0


@dataclass(frozen=True, kw_only=True)
class ImagesOptions(RenderOptions):
    """Options of `rbpf simulate desk` and `rbpf simulate room`."""

    focal_fraction = 0.8
    frames: Annotated[int, Range(ge=2, le=MOST)] = 300  #: number of images, 30 per second.
    focal_px: RealPositive = None  #: focal length, px; by default 0.8 of the width.
    board: Text = None  #: inner corners (columns x rows) of a chessboard on the desk, such as 9x6; by default none.
    square: RealPositive = None  #: side of the chessboard's squares, m; by default none.


@dataclass(frozen=True, kw_only=True)
class SimulateDesk(ImagesOptions):
    """Images of a textured desk with papers, books and boxes on it, taken by a hand-held camera, with ground truth."""

    def __call__(self) -> None:
        from rbpf.validation.simulation.desk_and_room import TexturedDesk

        lies = TexturedDesk(frames=self.frames, contrast=self.contrast)
        board = given_board(self.board, self.square)
        if board is not None:
            lies = replace(lies, board=(board.columns + 1, board.rows + 1), square_m=board.square_m)
        render(lies, self)


@dataclass(frozen=True, kw_only=True)
class SimulateRoom(ImagesOptions):
    """Images of a room with pictures on its walls, taken by a camera carried in a circle, with ground truth."""

    def __call__(self) -> None:
        from rbpf.validation.simulation.desk_and_room import TexturedRoom

        if self.board is not None or self.square is not None:
            raise InputError("a room has no chessboard: leave out --board and --square, or simulate a desk")
        render(TexturedRoom(frames=self.frames, contrast=self.contrast), self)


SIMULATE = Commands(
    "Simulate a recording, with ground truth.",
    {"range-bearing": SimulateRangeBearing, "laser": SimulateLaser, "desk": SimulateDesk, "room": SimulateRoom},
    compile_kernels,
)


def render(world: "ImageWorld", options: RenderOptions) -> None:
    """Renders the images of a world for a command, and reports it."""
    from rbpf.sensors.camera import Pinhole
    from rbpf.validation.simulation.images import Imaging, simulate_images

    if options.fisheye is not None and any(options.distortion):
        raise InputError("a lens has either --distortion or --fisheye: leave out one of them")
    lens, model = options.fisheye or options.distortion, "equidistant" if options.fisheye else "radial-tangential"
    focal = options.focal_px or options.focal_fraction * options.width
    centre = 0.5 * (options.width - 1), 0.5 * (options.height - 1)
    camera = Pinhole(options.width, options.height, focal, focal, *centre, lens, model)
    first, count = options.blackout or (0, 0)
    same = "noise_std", "exposure_drift", "blur_s", "vignetting", "depth", "known", "jpeg"
    imaging = Imaging(blackout=range(first, first + count), **{name: getattr(options, name) for name in same})
    with progress() as bar:
        simulate_images(world, imaging, camera, options.out, options.seed, bar("rendering"), options.baseline_m)
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file()) / 1e6
    answer({"out": str(options.out), "megabytes": round(size, 1)}, options.json, f"wrote {options.out}, {size:.0f} MB")
