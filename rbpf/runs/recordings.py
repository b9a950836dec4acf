"""Recordings as inputs of systems, opened as a system and the source of its frames."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.motion.odometry import Odometry
from rbpf.runs.files import CHECKPOINT, prepare_folder
from rbpf.runs.provenance import decisive_inputs
from rbpf.runs.run import Listener, Run, Source, drive
from rbpf.runs.truth import truth_at
from rbpf.sensors import readers
from rbpf.sensors.calibration import Board, MarkerBoard, find_board, find_markers
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog, Truth
from rbpf.sensors.readers.images.sequence import UNNAMED as NO_TOPICS
from rbpf.sensors.readers.images.video import LiveCamera
from rbpf.sensors.readers.part import WHOLE
from rbpf.sensors.readers.robot_log import UNNAMED
from rbpf.systems.laser.config import LaserConfig
from rbpf.systems.laser.slam import LaserSlam
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.image_sensor import ImageScreen
from rbpf.systems.mono.known_map import KnownMap, map_file, read_known_map
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.named_pixels import NamedFrontEnd
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.system import System

Sources = dict[str, str | float | bool]  #: A run's inputs, by their names in config.yaml.


class Opened(NamedTuple):
    """An opened recording: a new system, the source of its frames, their times (T,), and the truth.

    Times are None if unknown in advance, and so is a missing truth.
    """

    system: System
    source: Source
    stamps_ns: np.ndarray | None
    truth: Truth | None


@dataclass(frozen=True)
class LogSource:
    """The frames of a log that is in memory: a robot's, or a camera's named features."""

    log: Any

    @property
    def name(self) -> str:
        return str(self.log.name)

    def frames(self, start: int = 0) -> Iterator[Any]:
        return iter(self.log.frames[start:])


@dataclass(frozen=True)
class RobotRecording:
    """A robot's log."""

    log: Path  #: folder or file of a known kind.
    part: readers.Part = WHOLE  #: which of its frames.

    def open(self, config: RangeBearingConfig) -> Opened:
        return open_robot_log(part_of_log(readers.open_log(self.log, config.noise), self.part), config)

    def sources(self) -> Sources:
        return {"recording": str(self.log)} | self.part.entries()


@dataclass(frozen=True)
class MonoRecording:
    """Images of one camera, and prior knowledge: at most one of known points, board, markers and map."""

    images: Path  #: a sequence of any kind that `open_images` knows, or the number of a camera at this computer.
    known_points: Path | None = None  #: table of known points; None starts without any.
    calibration: Path | None = None  #: camera.yaml in place of the sequence's own camera.
    #: chessboard that is seen in the first image; its corners are the known points, in its frame.
    board: Board | None = None
    #: run folder, or its map, in which the camera is localised; the map is not changed. None creates a map.
    map: Path | None = None
    #: board of ArUco markers of which some are seen in the first image; likewise known points.
    markers: MarkerBoard | None = None
    topics: readers.Topics = NO_TOPICS  #: of a ROS bag, which images and which truth.
    #: which of the images, and in which size; known points are those of the first of them, in the recording's pixels.
    part: readers.Part = WHOLE

    def __post_init__(self) -> None:
        if len(self.topics.images) > 1:
            raise InputError(f"one camera has one topic of images: give one of {' and '.join(self.topics.images)}")
        starts = sum(start is not None for start in (self.known_points, self.board, self.markers))
        if starts > 1:
            raise InputError("a run starts from markers, a chessboard or known points: give one of the three")
        if self.map is not None and starts:
            raise InputError("in a known map a run starts from the map: leave out known points and chessboard")

    def open(self, config: MonoConfig) -> Opened:
        known_map = None if self.map is None else read_known_map(self.map)
        sequence, known = self.sequence()
        return open_mono(sequence, config, known, known_map)

    @property
    def live(self) -> int | None:
        """The number of a live camera; None for a recording, also one of that name."""
        is_number = str(self.images).isdecimal() and not self.images.exists()
        return int(str(self.images)) if is_number else None

    def sequence(self) -> tuple[readers.ImageSequence | LiveCamera, readers.KnownPixels | None]:
        """The images, and the known points if there are any; errors as `open`."""
        if self.live is not None and self.known_points is not None:
            raise InputError(
                "known points need a first image: start a live camera from --board or --aruco, or without them"
            )
        known = None if self.known_points is None else readers.read_known_points(self.known_points)
        sequence: readers.ImageSequence | LiveCamera
        if self.live is not None:
            if self.part != WHOLE:
                raise InputError("a live camera's images are used as they are: leave out start, end, every and resize")
            sequence = LiveCamera(self.live, self.calibration)
        else:
            sequence = whole = readers.open_images(self.images, self.calibration, self.topics)
            if self.part != WHOLE:
                sequence = self.part.apply(whole)
            if known is not None and sequence.camera != whole.camera:
                before, now = ((c.width, c.height) for c in (whole.camera, sequence.camera))
                known = replace(known, px=(known.px + 0.5) * (np.array(now) / before) - 0.5)
        if self.board is not None:
            known = find_board(first_image(sequence), self.board)
        if self.markers is not None:
            known = find_markers(first_image(sequence), self.markers)
        return sequence, known

    def sources(self) -> Sources:
        found = _given(recording=self.images, known_points=self.known_points, calibration=self.calibration)
        if self.board is not None:
            found |= {"board": f"{self.board.columns}x{self.board.rows}", "square_m": self.board.square_m}
        if self.markers is not None:
            board = self.markers
            found |= {"aruco": f"{board.columns}x{board.rows}", "marker_m": board.side_m, "gap_m": board.gap_m}
            found["dictionary"] = board.dictionary
        if self.map is not None:
            # Only this file of a run's folder is an input: timings and plots may change.
            found |= {"known_map": str(map_file(self.map)), "localize": True}
        return found | self.topics.entries() | self.part.entries()


@dataclass(frozen=True)
class StereoRecording:
    """Pairs of images."""

    pairs: Path  #: a sequence of any kind that `open_stereo` knows.
    calibration: Path | None = None  #: camera.yaml in place of the sequence's own camera.
    topics: readers.Topics = NO_TOPICS  #: of a ROS bag, which images and which truth.
    part: readers.Part = WHOLE  #: which of the pairs, and in which size.

    def open(self, config: StereoConfig) -> Opened:
        return open_pairs(readers.open_stereo(self.pairs, self.calibration, topics=self.topics, part=self.part), config)

    def sources(self) -> Sources:
        found = _given(recording=self.pairs, calibration=self.calibration)
        return found | self.topics.entries() | self.part.entries()


@dataclass(frozen=True)
class LaserRecording:
    """A laser scanner's log."""

    log: Path  #: file or folder of a known kind.
    #: what it leaves open, and which of its scans.
    options: readers.LaserOptions = field(default_factory=readers.LaserOptions)

    def open(self, config: LaserConfig) -> Opened:
        log = readers.read_laser_log(self.log, self.options)
        return Opened(LaserSlam(log.scanner, config), LogSource(log), log.stamps_ns, None)

    def sources(self) -> Sources:
        options = self.options
        found = _given(recording=self.log, scanner=options.scanner, max_range=options.max_range_m)
        return found | ({"upside_down": True} if options.upside_down else {}) | options.part.entries()


def _given(**named: Path | str | float | None) -> Sources:
    """What is not None; paths as text."""
    return {name: str(v) if isinstance(v, Path) else v for name, v in named.items() if v is not None}


def part_of_log(log: readers.RobotLog, part: readers.Part) -> readers.RobotLog:
    """Some frames of a robot's log; the odometry over skipped frames is composed."""
    if part == WHOLE:
        return log
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    scale, unit = (1, "steps") if np.array_equal(stamps, np.arange(len(stamps))) else (1e-9, "s")
    rows = part.rows((stamps - stamps[0]) * scale, f"{log.name}: no frame is left", unit).tolist()
    frames = [replace(log.frames[rows[0]], delta=None, cov_delta=None)]
    for before, row in pairwise(rows):
        moved = Odometry.at_rest(log.space)
        for frame in log.frames[before + 1 : row + 1]:
            assert frame.delta is not None and frame.cov_delta is not None
            moved = moved.then(Odometry(frame.delta, frame.cov_delta), log.space)
        frames.append(replace(log.frames[row], delta=moved.delta, cov_delta=moved.cov))
    return replace(log, frames=frames)


def open_robot_log(log: readers.RobotLog, config: RangeBearingConfig) -> Opened:
    """A robot's log in memory. Raises InputError: known association is selected, and some landmarks have no name."""
    if config.association == "known" and any((frame.landmarks == UNNAMED).any() for frame in log.frames):
        raise InputError(f"{log.name} has observations without a landmark's name: filter it with --association ml")
    system = RangeBearingSlam.of_log(log, config, keep_associations=config.association == "ml")
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    return Opened(system, LogSource(log), stamps, log.truth)


def open_mono(
    sequence: readers.ImageSequence | LiveCamera,
    config: MonoConfig,
    known: readers.KnownPixels | None = None,
    known_map: KnownMap | None = None,
) -> Opened:
    """A sequence of images; with known points in the first one, a known map, or without either."""
    if known_map is None:
        image, problem = ImageScreen(sequence.camera).usable(first_image(sequence))
        if known is not None and image is None:  # the known points' pixels are those in this image
            raise InputError(f"{sequence.name}: the first image is needed to start: {problem}")
    return Opened(MonoSlam(sequence.camera, config, known, known_map), sequence, sequence.stamps_ns, sequence.truth)


def open_pairs(sequence: readers.ImageSequence, config: StereoConfig) -> Opened:
    """A sequence of pairs of images."""
    return Opened(StereoSlam(sequence.rig, config), sequence, sequence.stamps_ns, sequence.truth)


def open_features(log: FeatureLog, config: MonoConfig | StereoConfig) -> Opened:
    """A log of named features, of one camera or of a rectified pair, depending on the settings.

    A pair's log without times, whose stamps count its frames, is taken as one frame per second.
    """
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    system: System
    if isinstance(config, StereoConfig):
        if not isinstance(log.camera, RectifiedStereo):
            raise InputError(f"{log.name}: stereo SLAM needs a log of a rectified pair, this one is of one camera")
        counted = np.array_equal(stamps, np.arange(stamps.size))
        front_end = NamedFrontEnd(log.camera, config, ns_per_stamp=1_000_000_000 if counted else 1)
        system = StereoSlam(log.camera, config, front_end=front_end)
    else:
        if not isinstance(log.camera, Pinhole):
            raise InputError(f"{log.name}: monocular SLAM needs a log of one camera, this is a stereo log")
        system = MonoSlam(log.camera, config, log.known)
    return Opened(system, LogSource(log), stamps, log.truth)


def first_image(sequence: readers.ImageSequence | LiveCamera) -> np.ndarray:
    """The first image (H, W) of a run. Raises InputError: it cannot be read."""
    first = next(sequence.frames(), None)
    if first is None or first.image is None:
        reason = "it has no image" if first is None else first.problem
        raise InputError(f"{sequence.name}: the first image is needed to start: {reason}")
    return first.image


#: Input of a run from the command line: it can be opened repeatedly, and has its entries for config.yaml.
Recording = RobotRecording | MonoRecording | StereoRecording | LaserRecording


class SystemKind(NamedTuple):
    """Registry entry of a system, for command line, reports and sweeps."""

    config: type[Any]  #: of its settings.
    recording: Callable[..., Recording]  #: its input, from `paths` in their order.
    #: Names of a recording's paths in config.yaml; all but the first are optional.
    paths: tuple[str, ...] = ("recording",)


#: By name; a new system needs one line here.
SYSTEMS: Mapping[str, SystemKind] = {
    "range-bearing": SystemKind(RangeBearingConfig, RobotRecording),
    "laser": SystemKind(LaserConfig, LaserRecording),
    "mono": SystemKind(MonoConfig, MonoRecording, ("recording", "known_points", "calibration")),
    "stereo": SystemKind(StereoConfig, StereoRecording, ("recording", "calibration")),
}


def filter_recording(
    recording: Recording, config: Any, out: Path | None = None, resume: bool = False, listeners: Iterable[Listener] = ()
) -> Run:
    """Filters a recording to its end; checkpoints are stored in `out`, from which `resume` continues."""
    opened = recording.open(config)
    if out is None:
        return filter_opened(opened, listeners)
    prepare_folder(out)
    return filter_opened(opened, listeners, out / CHECKPOINT, resume, decisive_inputs(recording.sources(), out))


def filter_opened(
    opened: Opened,
    listeners: Iterable[Listener] = (),
    checkpoint: Path | None = None,
    resume: bool = False,
    inputs: Mapping[str, str] | None = None,
) -> Run:
    """Filters an opened recording to its end, with its truth; see `drive`, and `Run` for `inputs`."""
    system, source, stamps_ns, truth = opened
    run = Run(source, system, expected=None if stamps_ns is None else len(stamps_ns), inputs=inputs or {})
    drive(run, listeners, checkpoint, system.config.checkpoint_every, resume, stamps_ns)
    if truth is not None:
        run.truth = truth_at(system.space, truth, run.log.stamps_ns, system.gauge)
    return run


def filter_features(log: FeatureLog, config: MonoConfig | StereoConfig, listeners: Iterable[Listener] = ()) -> Run:
    """A log of named features, filtered to its end; a frame that cannot be filtered is an error."""
    run = filter_opened(open_features(log, config), listeners)
    if run.failure is not None:
        raise InputError(run.failure)
    return run
