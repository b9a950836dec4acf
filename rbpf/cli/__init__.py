"""The command line: thin, one function per command."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.extras import SubcommandApp

from rbpf.cli import judging
from rbpf.cli.options import (
    ImagesOptions,
    LabOptions,
    MonoOptions,
    RangeBearingOptions,
    StereoOptions,
    given_board,
)
from rbpf.cli.showing import CONSOLE, progress, told
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.validation.simulation.textured_scene import ImageWorld

FOCAL_SHARE = {ImagesOptions: 0.8, LabOptions: 0.78125}
"""Focal length by default, as a share of the images' width."""

APP, RUN, SIMULATE = SubcommandApp(), SubcommandApp(), SubcommandApp()


@RUN.command(name="range-bearing")
def run_range_bearing(options: Annotated[RangeBearingOptions, tyro.conf.arg(name="")]) -> None:
    """Range-bearing SLAM over a robot's log (FastSLAM 2.0), beside the batch optimum of the same measurements."""
    from rbpf.systems.range_bearing.config import RangeBearingConfig
    from rbpf.systems.settings import load_settings
    from rbpf.validation.range_bearing import finish_run, start_run

    given = _given(options, "particles", "seed", "association")
    config = load_settings(RangeBearingConfig, "range-bearing", options.config, options.set, given)
    _prepare(options.threads)
    with progress() as bar:
        task = bar.add_task("filtering", total=None)
        run = start_run(
            options.log,
            config,
            options.out,
            options.resume,
            told(bar, task),
        )
    if options.batch:
        CONSOLE.print("solving the batch problem with the same measurements …")
    entries = finish_run(run, options.log, options.out, options.batch)
    _print_summary(entries, options.out)


@RUN.command(name="mono")
def run_mono(options: Annotated[MonoOptions, tyro.conf.arg(name="")]) -> None:
    """Monocular SLAM over a sequence of images or a video (E06: active search, inverse depth, FastSLAM 2.0)."""
    from rbpf.systems.mono.config import MonoConfig
    from rbpf.systems.settings import load_settings
    from rbpf.validation.mono import Recording, Telling, finish_mono, start_mono
    from rbpf.validation.rerun_file import require_rerun

    if options.rerun is not None:
        require_rerun()
    config = load_settings(
        MonoConfig, "mono", options.config, options.set, _given(options, "particles", "seed")
    )
    board = given_board(options.board, options.square)
    recording = Recording(options.sequence, options.known_points, options.calibration, board)
    _prepare(options.threads)
    with progress() as bar:
        task = bar.add_task("filtering", total=None)
        run = start_mono(
            recording,
            config,
            options.out,
            options.resume,
            told(bar, task),
        )
        solving = bar.add_task("batch", total=None, visible=options.batch)
        drawing = bar.add_task("drawing", total=None, visible=options.video)
        telling = Telling(
            on_frame=told(bar, drawing),
            on_iteration=lambda count, _error: bar.update(solving, completed=count),
            batch_s=options.batch_limit,
        )
        entries = finish_mono(
            run, recording, options.out, options.video, options.rerun, options.batch, telling
        )
    _print_summary(entries, options.out)
    if run.failure is not None:
        raise InputError(f"{run.failure}; what was computed before it is in {options.out}")


@RUN.command(name="stereo")
def run_stereo(options: Annotated[StereoOptions, tyro.conf.arg(name="")]) -> None:
    """Stereo SLAM over a sequence of pairs of images (S05: SIFT landmarks, visual odometry, 400 particles)."""
    from rbpf.systems.settings import load_settings
    from rbpf.systems.stereo.config import StereoConfig
    from rbpf.validation.rerun_file import require_rerun
    from rbpf.validation.stereo import StereoRecording, finish_stereo, start_stereo

    if options.rerun is not None:
        require_rerun()
    given = _given(options, "particles", "seed", "dof")
    config = load_settings(StereoConfig, "stereo", options.config, options.set, given)
    recording = StereoRecording(options.sequence, options.calibration)
    _prepare(options.threads)
    with progress() as bar:
        task = bar.add_task("filtering", total=None)
        run = start_stereo(recording, config, options.out, options.resume, told(bar, task))
        drawing = bar.add_task("drawing", total=None, visible=options.video)
        entries = finish_stereo(run, recording, options.out, options.video, options.rerun, told(bar, drawing))
    _print_summary(entries, options.out)
    if run.failure is not None:
        raise InputError(f"{run.failure}; what was computed before it is in {options.out}")


@SIMULATE.command(name="range-bearing")
def simulate_range_bearing(
    out: Path,
    seed: int = 0,
    spatial: tyro.conf.FlagCreatePairsOff[bool] = False,
    steps: int = 200,
    landmarks: int = 60,
) -> None:
    """A log of a robot among landmarks, with ground truth.

    Args:
        out: folder for the log.
        seed: of the random generator.
        spatial: six degrees of freedom instead of three.
        steps: number of steps.
        landmarks: number of landmarks.
    """
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    simulate_robot(RobotWorld(steps, landmarks, spatial), out, seed)
    CONSOLE.print(f"wrote {out}")


@SIMULATE.command(name="desk")
def simulate_desk(options: Annotated[ImagesOptions, tyro.conf.arg(name="")]) -> None:
    """Images of a textured desk with papers, books and boxes on it, taken by a hand-held camera, with ground truth."""
    from rbpf.validation.simulation.textured_desk import TexturedDesk

    lies = TexturedDesk(frames=options.frames, contrast=options.contrast)
    board = given_board(options.board, options.square)
    if board is not None:
        squares = board.columns + 1, board.rows + 1
        lies = replace(lies, board=squares, square_m=board.square_m)
    _render(lies, options)


@SIMULATE.command(name="room")
def simulate_room(options: Annotated[ImagesOptions, tyro.conf.arg(name="")]) -> None:
    """Images of a room with pictures on its walls, carried in a circle, with ground truth."""
    from rbpf.validation.simulation.textured_room import TexturedRoom

    if options.board is not None or options.square is not None:
        raise InputError("a room has no chessboard: leave out --board and --square, or simulate a desk")
    _render(TexturedRoom(frames=options.frames, contrast=options.contrast), options)


@SIMULATE.command(name="lab")
def simulate_lab(options: Annotated[LabOptions, tyro.conf.arg(name="")]) -> None:
    """Stereo images of a laboratory of two rooms, taken from a robot, with ground truth and the wheels' odometry."""
    from rbpf.validation.simulation.textured_lab import LabDrive, TexturedLab

    drive = LabDrive(options.trajectory, options.frames, options.every)
    _render(TexturedLab(drive, texel_m=options.texel_m, contrast=options.contrast), options)


def _render(world: "ImageWorld", options: ImagesOptions | LabOptions) -> None:
    from rbpf.sensors.pinhole import Pinhole, RectifiedStereo
    from rbpf.validation.simulation.exposure import Imaging
    from rbpf.validation.simulation.images import simulate_images

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
    focal = options.focal_px or FOCAL_SHARE[type(options)] * options.width
    middle = 0.5 * (options.width - 1), 0.5 * (options.height - 1)
    camera = Pinhole(options.width, options.height, focal, focal, *middle, options.distortion)
    lens = camera if options.baseline_m is None else RectifiedStereo(camera, options.baseline_m)
    with progress() as bar:
        task = bar.add_task("rendering", total=options.frames)
        simulate_images(world, imaging, lens, options.out, options.seed, told(bar, task))
    CONSOLE.print(f"wrote {options.out}, {_megabytes(options.out):.0f} MB")


@APP.command(name="demo")
def demo(out: Path = Path("demo"), frames: int = 240) -> None:
    """Render a desk that a camera moves over, run monocular SLAM on the images, leave plots and the annotated video.

    Args:
        out: folder for the images and the results.
        frames: number of images.
    """
    images = out / "desk"
    if not (images / "known_points.csv").is_file():
        simulate_desk(ImagesOptions(images, frames=frames))
    run_mono(MonoOptions(images, images / "known_points.csv", out=out / "run"))


APP.command(RUN, name="run")
APP.command(SIMULATE, name="simulate")
APP.command(name="validate")(judging.validate)
APP.command(name="report")(judging.report)
APP.command(name="sweep")(judging.sweep)
APP.command(name="compare")(judging.compare)


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, runs the command; bad input becomes one sentence and exit code 2."""
    try:
        APP.cli(prog="rbpf", description="Rao-Blackwellised particle filters for SLAM.", args=arguments)
    except InputError as error:
        print(f"rbpf: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("rbpf: stopped; --resume goes on from the last checkpoint", file=sys.stderr)
        return 130
    return 0


def _given(options: object, *names: str) -> dict[str, object]:
    """Those of some options that were given."""
    values = {name: getattr(options, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def _prepare(threads: int | None) -> None:
    """Threads as asked for, and compiled kernels."""
    import numba

    from rbpf.kernels import compile_once

    if threads is not None:
        if not 1 <= threads <= numba.config.NUMBA_NUM_THREADS:
            raise InputError(f"--threads must lie in 1..{numba.config.NUMBA_NUM_THREADS}, got {threads}")
        numba.set_num_threads(threads)
    compile_once(lambda: CONSOLE.print("compiling the kernels, which takes a minute and is done once …"))


def _megabytes(folder: Path) -> float:
    """Size of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _print_summary(entries: dict[str, object], out: Path) -> None:
    for name, value in entries.items():
        CONSOLE.print(f"{name:>34}  {value:.6g}" if isinstance(value, float) else f"{name:>34}  {value}")
    CONSOLE.print(f"results, pictures and report.html are in {out}")
