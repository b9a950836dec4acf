"""`rbpf run`: one class per system, and the same run again."""

import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Optional

import tyro
from tyro.conf import OmitArgPrefixes as Group  # in the help; its options have no prefix

from rbpf.cli.commands import Commands
from rbpf.cli.compiling import compile_kernels
from rbpf.cli.options import MOST_PX, Flag, Printed, RealPositive, Text, Where, Whole, WholeCount, given_board
from rbpf.cli.showing import OnProgress, answer, progress, say
from rbpf.errors import InputError
from rbpf.ranges import Count, NotNegative, Range

if TYPE_CHECKING:
    from rbpf.runs.recordings import Recording
    from rbpf.runs.run import Run
    from rbpf.sensors.readers.part import Part
    from rbpf.systems.settings import Config
    from rbpf.systems.system import Tracked
    from rbpf.validation.report.live import RunView


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """Folder and kinds of results."""

    #: folder for the results; by default run, or the next of run-2, run-3, … if there are runs already; with --resume
    #: or --overwrite the latest of them.
    out: Where = None
    resume: Flag = False  #: continue from the checkpoint in the results' folder, if there is one.
    overwrite: Flag = False  #: replace the run in the results' folder.
    view: Flag = False  #: show the run live in the Rerun viewer.
    rerun: Where = None  #: also write a Rerun recording (.rrd) with its layout; by default none.


@dataclass(frozen=True, kw_only=True)
class ImageResultOptions(ResultOptions):
    """Folder and kinds of results."""

    batch: bool = True  #: also compute the batch optimum of the same measurements with GTSAM.
    #: maximum iterations of the batch adjustment, which is given up after them (the run's results remain); by default as
    #: many as linearise thirty million observations in total, at least 100.
    batch_limit: WholeCount = None
    video: bool = True  #: write the annotated video.


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """Settings of the filter and its computation."""

    #: seed of the random generators; by default 0, or as in --config.
    seed: Annotated[Whole, Range(ge=0, le=2**63 - 1)] = None
    config: Where = None  #: YAML file of settings, such as that of an earlier run; by default the system's own.
    #: a setting as key=value, such as resampling.scheme=residual.
    set: tyro.conf.UseAppendAction[tuple] = ()
    threads: Annotated[Whole, Range(ge=1, le=4096)] = None  #: number of threads of the kernels; by default all.


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """The used part of the recording."""

    start: NotNegative = 0.0  #: skip this many seconds at the start; steps for a log without times.
    end: RealPositive = None  #: stop this many seconds after the first frame; by default at the last one.
    every: Count = 1  #: use every n-th of these frames.

    def part(self, resize: int | None = None) -> "Part":
        """The used part of the recording."""
        from rbpf.sensors.readers.part import Part

        return Part(self.start, self.end, self.every, resize)


@dataclass(frozen=True, kw_only=True)
class ImageOptions(RecordingOptions):
    """The used part of the recording, and its camera."""

    #: camera.yaml, for the images before they are resized; by default the sequence's own calibration.
    calibration: Where = None
    #: resize the images to this smaller width in px, and adapt the calibration; by default they keep their size.
    resize: Annotated[Whole, Range(ge=1, le=MOST_PX)] = None
    #: for a ROS bag, the topic of the images, or LEFT,RIGHT; by default those in the bag.
    image_topic: Text = None
    truth_topic: Text = None  #: for a ROS bag, the topic of the camera's ground-truth poses; by default none.


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """Prior knowledge of the world: points, a board, or a map of an earlier run."""

    #: table of points of known position in the first image; by default none: the world is then the first camera's
    #: frame, of arbitrary scale.
    known_points: Where = None
    #: instead of known points, inner corners (columns x rows) of a chessboard fully visible in the first image, such
    #: as 9x6; the world is then the board's frame; by default none.
    board: Text = None
    square: RealPositive = None  #: side of the chessboard's squares, m; by default none.
    #: instead of known points, a board of ArUco markers (columns x rows), such as 5x7, some of them visible in the first
    #: image; the world is then the board's frame; by default none.
    aruco: Text = None
    marker: RealPositive = None  #: side of a marker, including its black border, m; by default none.
    gap: NotNegative = 0.01  #: gap between two markers, m.
    dictionary: str = "4x4_50"  #: ArUco dictionary of the markers, such as 4x4_50 or 6x6_250.
    #: folder of an earlier run, or its known_map.npz, with the map to localise in; by default a map is built.
    map: Where = None
    localize: Flag = False  #: localise in the known map of --map, which stays fixed.


@dataclass(frozen=True, kw_only=True)
class RunOptions(Printed):
    """Options of every `rbpf run`, in the groups of its help."""

    particles: WholeCount = None  #: number of particles.
    result: Group[ResultOptions] = ResultOptions()
    filter: Group[FilterOptions] = FilterOptions()
    recording: Group[RecordingOptions] = RecordingOptions()

    def settings(self, kind: "type[Config]", system: str, **own: Any) -> "Config":
        """The system's settings from --config, --set and options that are settings, common and system-specific."""
        from rbpf.systems.settings import load_settings

        named = {"particles": self.particles, "seed": self.filter.seed, **own}
        given = {name: value for name, value in named.items() if value is not None}
        return load_settings(kind, system, self.filter.config, self.filter.set, given)


@dataclass(frozen=True, kw_only=True)
class ImageRunOptions(RunOptions):
    """Options of every run over images."""

    result: Group[ImageResultOptions] = ImageResultOptions()
    recording: Group[ImageOptions] = ImageOptions()


@dataclass(frozen=True, kw_only=True)
class RunRangeBearing(RunOptions):
    """Range-bearing SLAM over a robot's log (FastSLAM 2.0), compared with the batch optimum of the same measurements."""

    #: recording: a folder of an MRCLAM or MRPT log, or a Victoria Park graph.
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    particles: WholeCount = None  #: number of particles; by default 100, or as in --config.
    #: data association: known, by the log's names, or ml, maximum likelihood; by default known, or as in --config.
    association: Annotated[
        Optional[Literal["known", "ml"]], tyro.conf.arg(metavar="{known,ml}", help_behavior_hint="")
    ] = None
    batch: bool = True  #: also compute the batch optimum of the same measurements with GTSAM.

    def __call__(self) -> None:
        from rbpf.runs.recordings import RobotRecording
        from rbpf.systems.range_bearing.config import RangeBearingConfig

        def tell(run: "Run") -> None:
            say(run.system.why_map)
            if self.batch:
                say("solving the batch problem with the same measurements …")

        config = self.settings(RangeBearingConfig, "range-bearing", association=self.association)
        _run(self, RobotRecording(self.log, self.recording.part()), config, tell, batch=self.batch)


@dataclass(frozen=True, kw_only=True)
class RunLaser(RunOptions):
    """Grid SLAM over a laser scanner's log (Grisetti et al. 2007: scan matching in each particle's own map)."""

    #: recording: a CARMEN log (FLASER, ROBOTLASER, RAWLASER with ODOM), plain or gzipped, or a ROS bag with LaserScan.
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    particles: WholeCount = None  #: number of particles; by default 30, or as in --config.
    scanner: Text = None  #: message (CARMEN) or topic (ROS) of the scans; by default the first in the log.
    max_range: RealPositive = None  #: maximum range, beyond which there is no return, m; by default the log's.
    upside_down: Flag = False  #: the scanner is mounted upside down, or its readings are in clockwise order.

    def __call__(self) -> None:
        from rbpf.runs.recordings import LaserRecording
        from rbpf.sensors.readers import LaserOptions
        from rbpf.systems.laser.config import LaserConfig

        options = LaserOptions(self.scanner, self.upside_down, self.max_range, self.recording.part())
        _run(self, LaserRecording(self.log, options), self.settings(LaserConfig, "laser"))


@dataclass(frozen=True, kw_only=True)
class RunMono(ImageRunOptions):
    """Monocular SLAM over a sequence of images or a video (E06: active search, inverse depth, FastSLAM 2.0)."""

    #: images: a folder in a known format (EuRoC, TUM RGB-D, KITTI, 7-Scenes, images with a camera.yaml), a video with a
    #: camera.yaml beside it, a ROS bag, or the number of a connected camera, such as 0.
    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    particles: WholeCount = None  #: number of particles; by default 50, or as in --config.
    world: Group[WorldOptions] = WorldOptions()

    def __call__(self) -> None:
        from rbpf.runs.recordings import MonoRecording
        from rbpf.sensors.calibration import MarkerBoard
        from rbpf.sensors.readers.images.sequence import Topics
        from rbpf.systems.mono.config import MonoConfig

        images, world = self.recording, self.world
        config = self.settings(MonoConfig, "mono")
        board = given_board(world.board, world.square)
        if world.localize != (world.map is not None):
            raise InputError("a camera is found in a known map with both: --map RUN --localize")
        if (world.aruco is None) != (world.marker is None):
            raise InputError("a board of markers needs number and side of them: --aruco 5x7 --marker 0.04 --gap 0.01")
        markers = None
        if world.aruco is not None and world.marker is not None:
            markers = MarkerBoard.parse(world.aruco, world.marker, world.gap, world.dictionary)
        topics = Topics.parse(images.image_topic, images.truth_topic)
        given_files = self.sequence, world.known_points, images.calibration
        recording = MonoRecording(*given_files, board, world.map, markers, topics, images.part(images.resize))
        video = self.result.video
        if recording.live is not None:
            if self.result.resume or self.result.rerun is not None:
                raise InputError("the images of a live camera are not kept: leave out --resume and --rerun")
            video = False
            say("Ctrl-C ends the recording; the results are written then")
        _run(self, recording, config, video=video, batch=self.result.batch, most_iterations=self.result.batch_limit)


@dataclass(frozen=True, kw_only=True)
class RunStereo(ImageRunOptions):
    """Stereo SLAM over a sequence of pairs of images (SIFT landmarks in a joint map, visual odometry)."""

    #: image pairs, rectified or with a calibration to rectify them: a folder of EuRoC ASL with cam0 and cam1, of KITTI
    #: odometry with image_0 and image_1, or a ROS bag with two image topics.
    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PAIRS")]
    particles: WholeCount = None  #: number of particles; by default 50, or as in --config.
    #: degrees of freedom of the camera: 6, or 3 in its x-z plane; by default 6, or as in --config.
    dof: Annotated[Optional[Literal[3, 6]], tyro.conf.arg(metavar="{3,6}", help_behavior_hint="")] = None

    def __call__(self) -> None:
        from rbpf.runs.recordings import StereoRecording
        from rbpf.sensors.readers.images.sequence import Topics
        from rbpf.systems.stereo.config import StereoConfig

        images = self.recording
        config = self.settings(StereoConfig, "stereo", dof=self.dof)
        topics = Topics.parse(images.image_topic, images.truth_topic)
        recording = StereoRecording(self.sequence, images.calibration, topics, images.part(images.resize))
        made = self.result
        _run(self, recording, config, video=made.video, batch=made.batch, most_iterations=made.batch_limit)


RUN = Commands(
    """Filter a recording; `rbpf run SYSTEM --help` says more.

  rbpf run mono walk.mp4 --calibration camera.yaml --out RUN
  rbpf run stereo PAIRS --out RUN
  rbpf run range-bearing LOG --out RUN
  rbpf run laser robot.clf --out RUN

`rbpf run --from RUN/config.yaml [--out NEW]` repeats a run: the same recording, the same settings, the same bytes.
It is refused if the recording has changed. Further options are those of the run's system.""",
    {"range-bearing": RunRangeBearing, "laser": RunLaser, "mono": RunMono, "stereo": RunStereo},
    compile_kernels,
)


def repeated(arguments: list[str]) -> list[str]:
    """`run --from RUN/config.yaml …` as the command that the run was started with, and its settings."""
    given = [part for word in arguments for part in (word.split("=", 1) if word.startswith("--from=") else [word])]
    if given[:1] != ["run"] or "--from" not in given or not given[1].startswith("--"):
        return arguments
    at = given.index("--from")
    if len(given) < at + 2:
        raise InputError("--from takes the config.yaml of a run: rbpf run --from RUN/config.yaml")
    from rbpf.runs.files import numbered
    from rbpf.runs.provenance import read_origin

    config, more = Path(given[at + 1]), given[1:at] + given[at + 2 :]
    words, out = read_origin(config), list[str]()
    if not any(word.partition("=")[0] == "--out" for word in more):
        last = "--resume" in more or "--overwrite" in more
        folder = config if config.is_dir() else config.parent
        out = ["--out", str(numbered(Path(f"{folder}-again"), last))]
    return ["run", *words, *out, *more]


#: Columns of a system with the numbers of matches and of searched features.
_FOUND = ("found", "searched"), ("observed", "features")
_RECENT = 50  #: Frames over which the frame rate is averaged.


def _telling(report: OnProgress) -> "Callable[[Run, Tracked], None]":
    """A listener that reports each frame: tracking state, matched of searched features, recent frame rate."""
    times: deque[float] = deque(maxlen=_RECENT)

    def tell(run: "Run", tracked: "Tracked") -> None:
        said: list[str] = [tracked.state]
        said += [f"found {tracked.values[a]} of {tracked.values[b]}" for a, b in _FOUND if b in tracked.values]
        times.append(time.monotonic())
        if times[-1] > times[0]:
            said.append(f"{(len(times) - 1) / (times[-1] - times[0]):.3g} {run.system.frame_word}s per second")
        report(len(run.log), run.expected or 0, ", ".join(said))

    return tell


@contextmanager
def patient(report: OnProgress) -> Iterator[OnProgress]:
    """Wraps the progress callback `report`: after Ctrl-C it stops the run at the next frame.

    A second Ctrl-C stops it at once, without a checkpoint of its own.
    """
    asked = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        if asked.is_set():
            raise KeyboardInterrupt("stopped; the same command with --resume goes on from the last checkpoint")
        asked.set()
        say("stopping after this frame; Ctrl-C again stops at once …")

    def listening(done: int, total: int | None, words: str = "") -> None:
        report(done, total, words)
        if asked.is_set():
            of = total or "an unknown number"
            raise KeyboardInterrupt(f"stopped after {done} of {of}; the same command with --resume goes on from there")

    if threading.current_thread() is not threading.main_thread():
        yield listening
        return
    before = signal.signal(signal.SIGINT, ask)
    try:
        yield listening
    finally:
        signal.signal(signal.SIGINT, before)


def _run(
    options: RunOptions,
    recording: "Recording",
    config: Any,
    filtered: "Callable[[Run], None]" = lambda run: None,
    **made: Any,
) -> None:
    """Filters, then writes all results in `made`, with a progress bar for each stage; see `finish_run`.

    `filtered` is called in between.
    """
    from rbpf.runs.files import holds_run, numbered, own_folder
    from rbpf.runs.recordings import filter_recording

    result = options.result
    if result.view or result.rerun is not None:
        from rbpf.validation.report.live import require_rerun, viewer

        require_rerun()
    # Set the requested threads, and lock the folder for the results.
    if result.resume and result.overwrite:
        raise InputError("a run goes on with --resume or begins again with --overwrite: leave out one of them")
    kept = result.resume or result.overwrite
    out = numbered(Path("run"), last=kept) if result.out is None else result.out
    if options.filter.threads is not None:
        import numba

        if not 1 <= options.filter.threads <= numba.config.NUMBA_NUM_THREADS:
            raise InputError(f"--threads must lie in 1..{numba.config.NUMBA_NUM_THREADS}, got {options.filter.threads}")
        numba.set_num_threads(options.filter.threads)
    with own_folder(out), progress() as bar:
        if holds_run(out) and not kept:
            raise InputError(
                f"{out} holds a run already: name another with --out, go on by --resume, or write over it by --overwrite"
            )
        shown: AbstractContextManager[RunView | None] = viewer(out.name) if result.view else nullcontext()
        with patient(bar("filtering")) as report, shown as view:
            listeners: list[Callable[[Run, Tracked], None]] = [_telling(report)]
            listeners += [] if view is None else [view]
            run = filter_recording(recording, config, out, result.resume, listeners)
            if view is not None:
                view.finish(run)
        filtered(run)
        # After the first frame, as it takes as long to import as everything above.
        from rbpf.validation.finish import finish_run

        drawing, solving = bar("drawing"), bar("batch")
        made |= {"on_frame": drawing, "on_iteration": lambda count, _error: solving(count, None)}
        try:
            entries = finish_run(run, out, recording.sources(), rerun=result.rerun, **made)
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(
                "stopped while the results were written; the same command with --resume filters only what is missing"
            ) from error
    problems = entries.get("problems", ())
    odd = [f"Remarks on single frames: {len(problems)}, the first: {problems[0]}"] if problems else []
    where = f"pictures and report.html are in {out}, all figures in its summary.json"
    answer(entries | {"out": str(out)}, options.json, *entries["sentences"], *odd, where)
    if run.failure is not None:
        raise InputError(f"{run.failure}; what was computed before it is in {out}")
