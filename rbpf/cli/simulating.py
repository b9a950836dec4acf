"""`rbpf simulate`: logs and images of worlds whose truth is known."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import tyro

from rbpf.cli.commands import Commands
from rbpf.cli.compiling import compile_kernels
from rbpf.cli.options import CorridorOptions, ImagesOptions, LabOptions, LogOptions, given_board
from rbpf.cli.showing import answer, megabytes, progress
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.validation.simulation.textured_scene import ImageWorld

FOCAL_FRACTION = {ImagesOptions: 0.8, LabOptions: 0.78125}
"""Focal length by default, as a fraction of the images' width."""

SIMULATE = Commands("Make a recording of a world whose truth is known.", compile_kernels)


@SIMULATE.add("range-bearing")
def simulate_range_bearing(options: Annotated[LogOptions, tyro.conf.arg(name="")]) -> None:
    """A log of a robot among landmarks, with ground truth."""
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    world = RobotWorld(options.steps, options.landmarks, options.spatial, unnamed=options.unnamed)
    simulate_robot(world, options.out, options.seed)
    answer({"out": str(options.out), "steps": options.steps}, options.json, f"wrote {options.out}")


@SIMULATE.add("laser")
def simulate_laser_log(options: Annotated[CorridorOptions, tyro.conf.arg(name="")]) -> None:
    """A log of a robot with a laser scanner that drives round a corridor, with ground truth."""
    from rbpf.validation.simulation.laser import LaserWorld, simulate_laser

    simulate_laser(LaserWorld(options.scans, options.laps), options.out, options.seed)
    answer({"out": str(options.out), "scans": options.scans}, options.json, f"wrote {options.out}")


@SIMULATE.add("desk")
def simulate_desk(options: Annotated[ImagesOptions, tyro.conf.arg(name="")]) -> None:
    """Images of a textured desk with papers, books and boxes on it, taken by a hand-held camera, with ground truth."""
    from rbpf.validation.simulation.desk_and_room import TexturedDesk

    lies = TexturedDesk(frames=options.frames, contrast=options.contrast)
    board = given_board(options.board, options.square)
    if board is not None:
        squares = board.columns + 1, board.rows + 1
        lies = replace(lies, board=squares, square_m=board.square_m)
    _render(lies, options)


@SIMULATE.add("room")
def simulate_room(options: Annotated[ImagesOptions, tyro.conf.arg(name="")]) -> None:
    """Images of a room with pictures on its walls, carried in a circle, with ground truth."""
    from rbpf.validation.simulation.desk_and_room import TexturedRoom

    if options.board is not None or options.square is not None:
        raise InputError("a room has no chessboard: leave out --board and --square, or simulate a desk")
    _render(TexturedRoom(frames=options.frames, contrast=options.contrast), options)


@SIMULATE.add("lab")
def simulate_lab(options: Annotated[LabOptions, tyro.conf.arg(name="")]) -> None:
    """Stereo images of a laboratory of two rooms, taken from a robot, with ground truth and the wheels' odometry."""
    from rbpf.validation.simulation.lab import LabDrive, TexturedLab

    drive = LabDrive(options.trajectory, options.frames, options.every)
    _render(TexturedLab(drive, texel_m=options.texel_m, contrast=options.contrast), options)


def _render(world: "ImageWorld", options: ImagesOptions | LabOptions) -> None:
    from rbpf.sensors.camera import Pinhole
    from rbpf.validation.simulation.images import Imaging, simulate_images

    if options.fisheye is not None and any(options.distortion):
        raise InputError("a lens has either --distortion or --fisheye: leave out one of them")
    lens: tuple[float, ...] = options.distortion
    model = "radial-tangential"
    if options.fisheye is not None:
        lens, model = options.fisheye, "equidistant"
    focal = options.focal_px or FOCAL_FRACTION[type(options)] * options.width
    centre = 0.5 * (options.width - 1), 0.5 * (options.height - 1)
    camera = Pinhole(options.width, options.height, focal, focal, *centre, lens, model)
    first, count = options.blackout or (0, 0)
    imaging = Imaging(
        noise_std=options.noise_std,
        exposure_drift=options.exposure_drift,
        blur_s=options.blur_s,
        vignetting=options.vignetting,
        blackout=range(first, first + count),
        depth=options.depth,
        known=options.known,
        jpeg=options.jpeg,
    )
    with progress() as bar:
        simulate_images(world, imaging, camera, options.out, options.seed, bar("rendering"), options.baseline_m)
    size = megabytes(options.out)
    answer({"out": str(options.out), "megabytes": round(size, 1)}, options.json, f"wrote {options.out}, {size:.0f} MB")
