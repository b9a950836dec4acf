"""`rbpf run`: one function per system, and the same run again."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rbpf.cli.commands import Commands
from rbpf.cli.compiling import compile_kernels, use_threads
from rbpf.cli.interrupts import finishing, patient
from rbpf.cli.options import (
    ImageRunOptions,
    LaserRunOptions,
    MonoOptions,
    RangeBearingOptions,
    RunOptions,
    StereoOptions,
    given,
    given_board,
    given_markers,
    given_part,
    given_topics,
)
from rbpf.cli.showing import OnProgress, answer, progress, say
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.runs.recordings import Recording
    from rbpf.runs.run import Run

RUN = Commands(
    """Filter a recording; `rbpf run SYSTEM --help` says more.

`rbpf run --from RUN/config.yaml [--out NEW]` repeats a run: the same recording, the same settings, the same bytes.
It is refused when the recording has changed. Further options are those of the run's system.""",
    compile_kernels,
)


@RUN.add("range-bearing")
def run_range_bearing(options: Annotated[RangeBearingOptions, tyro.conf.arg(name="")]) -> None:
    """Range-bearing SLAM over a robot's log (FastSLAM 2.0), beside the batch optimum of the same measurements."""
    from rbpf.runs.recordings import RobotRecording, filter_recording
    from rbpf.systems.range_bearing.config import RangeBearingConfig
    from rbpf.systems.settings import load_settings
    from rbpf.validation.finish import finish_run

    named = given(options, "particles", "seed", "association")
    config = load_settings(RangeBearingConfig, "range-bearing", options.config, options.set, named)
    with _prepared(options) as out:
        with progress() as bar, patient(bar("filtering")) as report:
            recording = RobotRecording(options.log, given_part(options))
            run = filter_recording(recording, config, out, options.resume, [listener(report)])
        say(run.system.why_map)
        if options.batch:
            say("solving the batch problem with the same measurements …")
        with finishing():
            entries = finish_run(run, out, recording.sources(), batch=options.batch)
    _finish(entries, options, out, run.failure)


@RUN.add("laser")
def run_laser(options: Annotated[LaserRunOptions, tyro.conf.arg(name="")]) -> None:
    """Grid SLAM over a laser scanner's log (Grisetti et al. 2007: scan matching in each particle's own map)."""
    from rbpf.runs.recordings import LaserRecording, filter_recording
    from rbpf.sensors.readers import LaserOptions
    from rbpf.systems.laser.config import LaserConfig
    from rbpf.systems.settings import load_settings
    from rbpf.validation.finish import finish_run

    config = load_settings(LaserConfig, "laser", options.config, options.set, given(options, "particles", "seed"))
    told = LaserOptions(options.scanner, options.upside_down, options.max_range, given_part(options))
    recording = LaserRecording(options.log, told)
    with _prepared(options) as out:
        with progress() as bar, patient(bar("filtering")) as report:
            run = filter_recording(recording, config, out, options.resume, [listener(report)])
        with finishing():
            entries = finish_run(run, out, recording.sources())
    _finish(entries, options, out, run.failure)


@RUN.add("mono")
def run_mono(options: Annotated[MonoOptions, tyro.conf.arg(name="")]) -> None:
    """Monocular SLAM over a sequence of images or a video (E06: active search, inverse depth, FastSLAM 2.0)."""
    from rbpf.runs.recordings import MonoRecording
    from rbpf.systems.mono.config import MonoConfig
    from rbpf.systems.settings import load_settings

    named = given(options, "particles", "seed")
    config = load_settings(MonoConfig, "mono", options.config, options.set, named)
    board = given_board(options.board, options.square)
    if options.localize != (options.map is not None):
        raise InputError("a camera is found in a known map with both: --map RUN --localize")
    markers, points = given_markers(options), options.known_points
    recording = MonoRecording(
        options.sequence,
        points,
        options.calibration,
        board,
        options.map,
        markers,
        given_topics(options),
        given_part(options),
    )
    video = options.video
    if recording.live is not None:
        if options.resume or options.rerun is not None:
            raise InputError("the images of a live camera are not kept: leave out --resume and --rerun")
        video = False
        say("Ctrl-C ends the recording; the results are written then")
    _run_images(options, recording, config, video)


@RUN.add("stereo")
def run_stereo(options: Annotated[StereoOptions, tyro.conf.arg(name="")]) -> None:
    """Stereo SLAM over a sequence of pairs of images (S05: SIFT landmarks, visual odometry, 400 particles)."""
    from rbpf.runs.recordings import StereoRecording
    from rbpf.systems.settings import load_settings
    from rbpf.systems.stereo.config import StereoConfig

    named = given(options, "particles", "seed", "dof")
    config = load_settings(StereoConfig, "stereo", options.config, options.set, named)
    recording = StereoRecording(options.sequence, options.calibration, given_topics(options), given_part(options))
    _run_images(options, recording, config, options.video)


def repeated(arguments: list[str]) -> list[str]:
    """`run --from RUN/config.yaml …` as the command that the run was started with, and its settings."""
    if arguments[:1] != ["run"] or "--from" not in arguments[:2]:
        return arguments
    if len(arguments) < 3:
        raise InputError("--from takes the config.yaml of a run: rbpf run --from RUN/config.yaml")
    from rbpf.runs.files import numbered
    from rbpf.runs.provenance import read_origin

    config = Path(arguments[2])
    origin = read_origin(config)
    options = ["--config", str(origin.config)]
    for name, value in origin.sources.items():
        options += [f"--{name}", value] if value else [f"--{name}"]
    out = []
    if not any(word.partition("=")[0] == "--out" for word in arguments):
        last = "--resume" in arguments or "--overwrite" in arguments
        out = ["--out", str(numbered(Path(f"{origin.config.parent}-again"), last))]
    return ["run", origin.system, origin.recording, *options, *out, *arguments[3:]]


def listener(report: OnProgress) -> Callable[["Run", object], None]:
    """What follows a run and reports how many frames are done, and of how many."""
    return lambda run, _: report(len(run.log), run.expected or 0)


def _run_images(options: ImageRunOptions, recording: "Recording", config: Any, video: bool) -> None:
    """Filters, then writes everything, with a bar for each stage of the work."""
    from rbpf.runs.recordings import filter_recording
    from rbpf.validation.finish import Callbacks, finish_run
    from rbpf.validation.report.rerun import require_rerun

    if options.rerun is not None:
        require_rerun()
    with _prepared(options) as out, progress() as bar:
        with patient(bar("filtering")) as report:
            run = filter_recording(recording, config, out, options.resume, [listener(report)])
        solving = bar("batch")
        callbacks = Callbacks(
            on_frame=bar("drawing"),
            on_iteration=lambda count, _error: solving(count, None),
            most_iterations=options.batch_limit,
        )
        with finishing():
            entries = finish_run(run, out, recording.sources(), video, options.rerun, options.batch, callbacks)
    _finish(entries, options, out, run.failure)


@contextmanager
def _prepared(options: RunOptions) -> Iterator[Path]:
    """Threads as asked for, and the folder for the results, which nobody else writes to."""
    from rbpf.runs.files import holds_run, numbered, own_folder

    if options.resume and options.overwrite:
        raise InputError("a run goes on with --resume or begins again with --overwrite: leave out one of them")
    kept = options.resume or options.overwrite
    out = numbered(Path("run"), last=kept) if options.out is None else options.out
    use_threads(options.threads)
    with own_folder(out):
        if holds_run(out) and not kept:
            raise InputError(
                f"{out} holds a run already: name another folder with --out, go on with --resume, or write over it "
                "with --overwrite"
            )
        yield out


def _finish(entries: dict[str, Any], options: RunOptions, out: Path, failure: str | None) -> None:
    result = entries | {"out": str(out)}
    problems = entries.get("problems", ())
    odd = [f"{len(problems)} remarks on single frames, the first: {problems[0]}"] if problems else []
    where = f"pictures and report.html are in {out}, all figures in its summary.json"
    answer(result, options.json, *entries["sentences"], *odd, where)
    if failure is not None:
        raise InputError(f"{failure}; what was computed before it is in {out}")
