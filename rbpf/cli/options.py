"""The options of the commands; what stands at a field is its help text, and what several commands share is said once."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rbpf.errors import InputError
from rbpf.ranges import MOST, Count, CountOrNone, Fraction, NotNegative, Range, Seed, SettingError, check_ranges

if TYPE_CHECKING:
    from rbpf.sensors.calibration import Board, MarkerBoard
    from rbpf.sensors.readers.images.sequence import Topics
    from rbpf.sensors.readers.part import Part

Flag = tyro.conf.FlagCreatePairsOff[bool]

# What is None unless it is given: the help says in words what that means.
Whole = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]
Real = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
WholeCount = Annotated[Whole, Range(ge=1, le=MOST)]
RealPositive = Annotated[Real, Range(gt=0.0)]
Text = Annotated[str | None, tyro.conf.arg(metavar="STR", help_behavior_hint="")]
Where = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]

MOST_PX = 1 << 15
"""Of a side of an image."""


@dataclass(frozen=True, kw_only=True)
class Printed:
    """Of every command that has a result."""

    json: Flag = False  #: print the result as one JSON object on standard output, for programs.

    def __post_init__(self) -> None:
        try:
            check_ranges(self)
        except SettingError as error:
            raise InputError(f"--{error.name.replace('_', '-')} {error.words}") from error


@dataclass(frozen=True, kw_only=True)
class RunOptions(Printed):
    """Of every `rbpf run`."""

    #: folder for the results; by default run, or run-2, run-3, … where there are runs already; the last of them to
    #: resume or to overwrite.
    out: Where = None
    particles: WholeCount = None  #: number of particles.
    #: of the random generators; by default 0, or as in --config.
    seed: Annotated[Whole, Range(ge=0, le=2**63 - 1)] = None
    config: Where = None  #: YAML file of settings, such as a former run's config.yaml; by default the system's own.
    #: a setting as key=value, such as resampling.scheme=residual; may be given several times.
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    resume: Flag = False  #: go on from the checkpoint in the results' folder, if there is one.
    overwrite: Flag = False  #: write over the run that lies in the results' folder.
    threads: Annotated[Whole, Range(ge=1, le=4096)] = None  #: threads of the kernels; by default all.


@dataclass(frozen=True, kw_only=True)
class PartOptions(RunOptions):
    """Of every run over a recording, of which a part may be used."""

    start: NotNegative = 0.0  #: use the frames from so many seconds after the first on; of a log without times, steps.
    end: RealPositive = None  #: use the frames until so many seconds after the first; by default all.
    every: Count = 1  #: of these use each so many-th.


@dataclass(frozen=True, kw_only=True)
class RangeBearingOptions(PartOptions):
    """Options of `rbpf run range-bearing`."""

    #: recording: a folder of an MRCLAM or MRPT log, or a Victoria Park graph.
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    particles: WholeCount = None  #: number of particles; by default 100, or as in --config.
    #: landmarks named by the log, or by maximum likelihood; by default known, or as in --config.
    association: Annotated[
        Literal["known", "ml"] | None, tyro.conf.arg(metavar="{known,ml}", help_behavior_hint="")
    ] = None
    batch: bool = True  #: also solve for the batch optimum with GTSAM.


@dataclass(frozen=True, kw_only=True)
class LaserRunOptions(PartOptions):
    """Options of `rbpf run laser`."""

    #: recording: a CARMEN log (FLASER, ROBOTLASER, RAWLASER with ODOM), plain or packed by gzip, or a ROS bag with
    #: LaserScan.
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    particles: WholeCount = None  #: number of particles; by default 30, or as in --config.
    scanner: Text = None  #: message (CARMEN) or topic (ROS) of the scans; by default the first that the log has.
    max_range: RealPositive = None  #: what is farther gives no return, m; by default what the log says.
    upside_down: Flag = False  #: the scanner is mounted upside down, or its readings run clockwise.


@dataclass(frozen=True, kw_only=True)
class ImageRunOptions(PartOptions):
    """Of every run over images."""

    #: camera.yaml in place of the sequence's own, of the images before they are resized; by default that one is read.
    calibration: Where = None
    #: make the images smaller, to this width in px, and the calibration with them; by default they stay as they are.
    resize: Annotated[Whole, Range(ge=1, le=MOST_PX)] = None
    #: of a ROS bag, the topic of the images, or LEFT,RIGHT; by default those that the bag has.
    image_topic: Text = None
    truth_topic: Text = None  #: of a ROS bag, the topic of the camera's true poses; by default none.
    rerun: Where = None  #: also write a recording (.rrd) for the Rerun viewer; by default none.
    batch: bool = True  #: also adjust the same measurements in batch with GTSAM.
    #: iterations after which the batch adjustment is given up, the run's results stay; by default so many that thirty
    #: million sightings are linearised.
    batch_limit: WholeCount = None
    video: bool = True  #: write the annotated video.


@dataclass(frozen=True, kw_only=True)
class MonoOptions(ImageRunOptions):
    """Options of `rbpf run mono`."""

    #: images: a folder of a known kind (EuRoC, TUM RGB-D, KITTI, 7-Scenes, images with a camera.yaml), a video with a
    #: camera.yaml beside it, a ROS bag, or the number of a camera at this computer, as 0.
    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    particles: WholeCount = None  #: number of particles; by default 50, or as in --config.
    #: table of points of known position that are seen in the first image; by default none: the world is the first
    #: camera's and its scale is arbitrary.
    known_points: Where = None
    #: in place of known points, inner corners of a chessboard that is seen whole in the first image, as 9x6; the
    #: world is then the board's; by default none.
    board: Text = None
    square: RealPositive = None  #: side of its squares, m; by default none.
    #: in place of known points, a board of so many ArUco markers, as 5x7, of which some are seen in the first image;
    #: the world is then the board's; by default none.
    aruco: Text = None
    marker: RealPositive = None  #: side of a marker, its black border included, m; by default none.
    gap: NotNegative = 0.01  #: between two markers, m.
    dictionary: str = "4x4_50"  #: of the markers' patterns, as 4x4_50 or 6x6_250.
    #: folder of a run, or its known_map.npz, that the camera is to be found in; by default a map is made.
    map: Where = None
    localize: Flag = False  #: the map is known: the start is found by recognition, and the map is not changed.


@dataclass(frozen=True, kw_only=True)
class StereoOptions(ImageRunOptions):
    """Options of `rbpf run stereo`."""

    #: images of a rectified pair, or of one that its calibration rectifies: a folder of EuRoC ASL with cam0 and cam1,
    #: of KITTI odometry with image_0 and image_1, or a ROS bag with two topics of images.
    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PAIRS")]
    particles: WholeCount = None  #: number of particles; by default 400, or as in --config.
    #: degrees of freedom of the camera: 6, or 3 in its x-z plane; by default 6, or as in --config.
    dof: Annotated[Literal[3, 6] | None, tyro.conf.arg(metavar="{3,6}", help_behavior_hint="")] = None


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Printed):
    """Of every `rbpf simulate` that renders images."""

    #: folder for the sequence (EuRoC ASL, with camera.yaml and known_points.csv); must not exist, or be empty.
    out: Path
    seed: Seed = 0  #: of the random generator.
    width: Annotated[int, Range(ge=2, le=MOST_PX)] = 640  #: of the images, px.
    height: Annotated[int, Range(ge=2, le=MOST_PX)] = 480  #: of the images, px.
    focal_px: RealPositive = None  #: focal length, px; by default a fraction of the width.
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  #: k1, k2, p1, p2, k3 of the lens.
    #: k1, k2, k3, k4 of an equidistant lens in its place; by default none. The ideal one has 0 0 0 0; it sees 140
    #: degrees where the focal length is 0.41 of the width.
    fisheye: tuple[float, float, float, float] | None = None
    baseline_m: Real = None  #: of a second camera to the right, m; None or nothing for none.
    known: CountOrNone = 6  #: corners in the first image whose positions are given, at least 4; 0 for none.
    noise_std: NotNegative = 3.0  #: of the sensor, grey levels.
    blur_s: NotNegative = 0.01  #: the shutter is open this long, s.
    exposure_drift: Fraction = 0.15  #: greatest change of the exposure, as a fraction.
    vignetting: Fraction = 0.2  #: fraction of the light that is missing in the corners.
    contrast: NotNegative = 1.0  #: of all textures; 1 is rich, 0.1 poor.
    #: first frame in the dark and number of frames; by default none.
    blackout: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="INT INT", help_behavior_hint="")] = None
    depth: Flag = False  #: also write depth images.
    #: quality of JPEG files, 1 to 100; 0 writes PNG, which loses nothing.
    jpeg: Annotated[int, Range(ge=0, le=100)] = 0


@dataclass(frozen=True, kw_only=True)
class ImagesOptions(RenderOptions):
    """Options of `rbpf simulate desk` and `rbpf simulate room`."""

    frames: Annotated[int, Range(ge=2, le=MOST)] = 300  #: number of images, 30 per second.
    focal_px: RealPositive = None  #: focal length, px; by default 0.8 of the width.
    board: Text = None  #: a chessboard of so many inner corners lies on the desk, as 9x6; by default none.
    square: RealPositive = None  #: side of its squares, m; by default none.


@dataclass(frozen=True, kw_only=True)
class LabOptions(RenderOptions):
    """Options of `rbpf simulate lab`. The sensor's noise is that of dim light; odometry.csv is written too."""

    #: a tour of 4,000 images over 68 m through both rooms and back, or 600 images on which the robot twice looks away
    #: for 5 s and back.
    trajectory: Literal["tour", "turn_back"] = "tour"
    frames: WholeCount = None  #: only so many images, the first; by default all.
    every: Count = 1  #: only each so many-th frame becomes an image.
    focal_px: RealPositive = None  #: focal length, px; by default 0.78125 of the width, 500 px at 640.
    #: of a second camera to the right, m; None or nothing for none.
    baseline_m: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = 0.12
    noise_std: NotNegative = 8.0  #: of the sensor, grey levels.
    blur_s: NotNegative = 0.0  #: the shutter is open this long, s.
    exposure_drift: Fraction = 0.0  #: greatest change of the exposure, as a fraction.
    vignetting: Fraction = 0.0  #: fraction of the light that is missing in the corners.
    texel_m: Annotated[float, Range(ge=1e-4, le=1.0)] = 0.003  #: side of a texel, m; larger ones are drawn sooner.


@dataclass(frozen=True, kw_only=True)
class LogOptions(Printed):
    """Options of `rbpf simulate range-bearing`."""

    out: Path  #: folder for the log.
    seed: Seed = 0  #: of the random generator.
    spatial: Flag = False  #: six degrees of freedom instead of three.
    steps: Annotated[int, Range(ge=2, le=MOST)] = 200  #: number of steps, one a second.
    landmarks: Count = 60  #: number of landmarks.
    unnamed: Flag = False  #: the log does not say which landmark was observed.


@dataclass(frozen=True, kw_only=True)
class CorridorOptions(Printed):
    """Options of `rbpf simulate laser`."""

    out: Path  #: folder for the log robot.clf, the path truth.tum, and robot.relations.
    seed: Seed = 0  #: of the random generator.
    scans: Annotated[int, Range(ge=2, le=MOST)] = 400  #: number of scans.
    laps: Annotated[int, Range(ge=1, le=1000)] = 2  #: number of rounds.


def given(options: object, *names: str) -> dict[str, object]:
    """Those of some options that were given."""
    values = {name: getattr(options, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def given_topics(options: ImageRunOptions) -> "Topics":
    """The topics of `--image-topic` and `--truth-topic`."""
    from rbpf.sensors.readers.images.sequence import Topics

    return Topics.parse(options.image_topic, options.truth_topic)


def given_part(options: PartOptions) -> "Part":
    """The part of `--start`, `--end`, `--every` and, of images, `--resize`."""
    from rbpf.sensors.readers.part import Part

    resize = options.resize if isinstance(options, ImageRunOptions) else None
    return Part(options.start, options.end, options.every, resize)


def given_markers(options: MonoOptions) -> "MarkerBoard | None":
    """The board of `--aruco` and `--marker`."""
    if options.aruco is None and options.marker is None:
        return None
    if options.aruco is None or options.marker is None:
        raise InputError("a board of markers needs their number and their side: --aruco 5x7 --marker 0.04 --gap 0.01")
    from rbpf.sensors.calibration import MarkerBoard

    return MarkerBoard.parse(options.aruco, options.marker, options.gap, options.dictionary)


def given_board(size: str | None, square_m: float | None) -> "Board | None":
    """The chessboard of `--board` and `--square`."""
    if size is None and square_m is None:
        return None
    if size is None or square_m is None:
        raise InputError(
            "a chessboard needs both its inner corners and the side of its squares: --board 9x6 --square 0.024"
        )
    from rbpf.sensors.calibration import Board

    return Board.parse(size, square_m)
