"""The options of the commands; their docstrings are the help texts, and what several commands share is said once."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rbpf.errors import InputError
from rbpf.ranges import MOST, Count, CountOrNone, Fraction, NotNegative, Range, Seed, SettingError, check_ranges

if TYPE_CHECKING:
    from rbpf.sensors.calibration import Board, MarkerBoard
    from rbpf.sensors.readers.images.part import Part
    from rbpf.sensors.readers.images.sequence import Topics

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
    """Of every command that has a result.

    Attributes:
        json: print the result as one JSON object on standard output, for programs.
    """

    json: Flag = False

    def __post_init__(self) -> None:
        try:
            check_ranges(self)
        except SettingError as error:
            raise InputError(f"--{error.name.replace('_', '-')} {error.words}") from error


@dataclass(frozen=True, kw_only=True)
class RunOptions(Printed):
    """Of every `rbpf run`.

    Attributes:
        out: folder for the results; by default run, or run-2, run-3, … where there are runs already; the last of them to
            resume or to overwrite.
        particles: number of particles.
        seed: of the random generators; by default 0, or as in --config.
        config: YAML file of settings, such as a former run's config.yaml; by default the system's own.
        set: a setting as key=value, such as resampling.scheme=residual; may be given several times.
        resume: go on from the checkpoint in the results' folder, if there is one.
        overwrite: write over the run that lies in the results' folder.
        threads: threads of the kernels; by default all.
    """

    out: Where = None
    particles: WholeCount = None
    seed: Annotated[Whole, Range(ge=0, le=2**63 - 1)] = None
    config: Where = None
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    resume: Flag = False
    overwrite: Flag = False
    threads: Annotated[Whole, Range(ge=1, le=4096)] = None


@dataclass(frozen=True, kw_only=True)
class PartOptions(RunOptions):
    """Of every run over a recording, of which a part may be used.

    Attributes:
        start: use the frames from so many seconds after the first on; of a log without times, steps.
        end: use the frames until so many seconds after the first; by default all.
        every: of these use each so many-th.
    """

    start: NotNegative = 0.0
    end: RealPositive = None
    every: Count = 1


@dataclass(frozen=True, kw_only=True)
class RangeBearingOptions(PartOptions):
    """Options of `rbpf run range-bearing`.

    Attributes:
        log: recording: a folder of an MRCLAM or MRPT log, or a Victoria Park graph.
        particles: number of particles; by default 100, or as in --config.
        association: landmarks named by the log, or by maximum likelihood; by default known, or as in --config.
        batch: also solve for the batch optimum with GTSAM.
    """

    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG")]
    particles: WholeCount = None
    association: Annotated[
        Literal["known", "ml"] | None, tyro.conf.arg(metavar="{known,ml}", help_behavior_hint="")
    ] = None
    batch: bool = True


@dataclass(frozen=True, kw_only=True)
class ImageRunOptions(PartOptions):
    """Of every run over images.

    Attributes:
        calibration: camera.yaml in place of the sequence's own, of the images before they are resized; by default that one
            is read.
        resize: make the images smaller, to this width in px, and the calibration with them; by default they stay as they are.
        image_topic: of a ROS bag, the topic of the images, or LEFT,RIGHT; by default those that the bag has.
        truth_topic: of a ROS bag, the topic of the camera's true poses; by default none.
        rerun: also write a recording (.rrd) for the Rerun viewer; by default none.
        batch: also adjust the same measurements in batch with GTSAM.
        batch_limit: iterations after which the batch adjustment is given up, the run's results stay; by default so many
            that thirty million sightings are linearised.
        video: write the annotated video.
    """

    calibration: Where = None
    resize: Annotated[Whole, Range(ge=1, le=MOST_PX)] = None
    image_topic: Text = None
    truth_topic: Text = None
    rerun: Where = None
    batch: bool = True
    batch_limit: WholeCount = None
    video: bool = True


@dataclass(frozen=True, kw_only=True)
class MonoOptions(ImageRunOptions):
    """Options of `rbpf run mono`.

    Attributes:
        sequence: images: a folder of a known kind (EuRoC, TUM RGB-D, KITTI, 7-Scenes, images with a camera.yaml), a
            video with a camera.yaml beside it, a ROS bag, or the number of a camera at this computer, as 0.
        particles: number of particles; by default 50, or as in --config.
        known_points: table of points of known position that are seen in the first image; by default none: the world is
            the first camera's and its scale is arbitrary.
        board: in place of known points, inner corners of a chessboard that is seen whole in the first image, as 9x6;
            the world is then the board's; by default none.
        square: side of its squares, m; by default none.
        aruco: in place of known points, a board of so many ArUco markers, as 5x7, of which some are seen in the first
            image; the world is then the board's; by default none.
        marker: side of a marker, its black border included, m; by default none.
        gap: between two markers, m.
        dictionary: of the markers' patterns, as 4x4_50 or 6x6_250.
        map: folder of a run, or its known_map.npz, that the camera is to be found in; by default a map is made.
        localize: the map is known: the start is found by recognition, and the map is not changed.
    """

    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    particles: WholeCount = None
    known_points: Where = None
    board: Text = None
    square: RealPositive = None
    aruco: Text = None
    marker: RealPositive = None
    gap: NotNegative = 0.01
    dictionary: str = "4x4_50"
    map: Where = None
    localize: Flag = False


@dataclass(frozen=True, kw_only=True)
class StereoOptions(ImageRunOptions):
    """Options of `rbpf run stereo`.

    Attributes:
        sequence: images of a rectified pair, or of one that its calibration rectifies: a folder of EuRoC ASL with cam0
            and cam1, of KITTI odometry with image_0 and image_1, or a ROS bag with two topics of images.
        particles: number of particles; by default 400, or as in --config.
        dof: degrees of freedom of the camera: 6, or 3 in its x-z plane; by default 6, or as in --config.
    """

    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PAIRS")]
    particles: WholeCount = None
    dof: Annotated[Literal[3, 6] | None, tyro.conf.arg(metavar="{3,6}", help_behavior_hint="")] = None


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Printed):
    """Of every `rbpf simulate` that renders images.

    Attributes:
        out: folder for the sequence (EuRoC ASL, with camera.yaml and known_points.csv); must not exist, or be empty.
        seed: of the random generator.
        width: of the images, px.
        height: of the images, px.
        focal_px: focal length, px; by default a fraction of the width.
        distortion: k1, k2, p1, p2, k3 of the lens.
        fisheye: k1, k2, k3, k4 of an equidistant lens in its place; by default none. The ideal one has 0 0 0 0; it
            sees 140 degrees where the focal length is 0.41 of the width.
        baseline_m: of a second camera to the right, m; None or nothing for none.
        known: corners in the first image whose positions are given, at least 4; 0 for none.
        noise_std: of the sensor, grey levels.
        blur_s: the shutter is open this long, s.
        exposure_drift: greatest change of the exposure, as a fraction.
        vignetting: fraction of the light that is missing in the corners.
        contrast: of all textures; 1 is rich, 0.1 poor.
        blackout: first frame in the dark and number of frames; by default none.
        depth: also write depth images.
        jpeg: quality of JPEG files, 1 to 100; 0 writes PNG, which loses nothing.
    """

    out: Path
    seed: Seed = 0
    width: Annotated[int, Range(ge=2, le=MOST_PX)] = 640
    height: Annotated[int, Range(ge=2, le=MOST_PX)] = 480
    focal_px: RealPositive = None
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    fisheye: tuple[float, float, float, float] | None = None
    baseline_m: Real = None
    known: CountOrNone = 6
    noise_std: NotNegative = 3.0
    blur_s: NotNegative = 0.01
    exposure_drift: Fraction = 0.15
    vignetting: Fraction = 0.2
    contrast: NotNegative = 1.0
    blackout: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="INT INT", help_behavior_hint="")] = None
    depth: Flag = False
    jpeg: Annotated[int, Range(ge=0, le=100)] = 0


@dataclass(frozen=True, kw_only=True)
class ImagesOptions(RenderOptions):
    """Options of `rbpf simulate desk` and `rbpf simulate room`.

    Attributes:
        frames: number of images, 30 per second.
        focal_px: focal length, px; by default 0.8 of the width.
        board: a chessboard of so many inner corners lies on the desk, as 9x6; by default none.
        square: side of its squares, m; by default none.
    """

    frames: Annotated[int, Range(ge=2, le=MOST)] = 300
    focal_px: RealPositive = None
    board: Text = None
    square: RealPositive = None


@dataclass(frozen=True, kw_only=True)
class LabOptions(RenderOptions):
    """Options of `rbpf simulate lab`. The sensor's noise is that of dim light; odometry.csv is written too.

    Attributes:
        trajectory: a tour of 4,000 images over 68 m through both rooms and back, or 600 images on which the robot twice
            looks away for 5 s and back.
        frames: only so many images, the first; by default all.
        every: only each so many-th frame becomes an image.
        focal_px: focal length, px; by default 0.78125 of the width, 500 px at 640.
        texel_m: side of a texel, m; larger ones are drawn sooner.
    """

    trajectory: Literal["tour", "turn_back"] = "tour"
    frames: WholeCount = None
    every: Count = 1
    focal_px: RealPositive = None
    baseline_m: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = 0.12
    noise_std: NotNegative = 8.0
    blur_s: NotNegative = 0.0
    exposure_drift: Fraction = 0.0
    vignetting: Fraction = 0.0
    texel_m: Annotated[float, Range(ge=1e-4, le=1.0)] = 0.003


@dataclass(frozen=True, kw_only=True)
class LogOptions(Printed):
    """Options of `rbpf simulate range-bearing`.

    Attributes:
        out: folder for the log.
        seed: of the random generator.
        spatial: six degrees of freedom instead of three.
        steps: number of steps, one a second.
        landmarks: number of landmarks.
        unnamed: the log does not say which landmark was observed.
    """

    out: Path
    seed: Seed = 0
    spatial: Flag = False
    steps: Annotated[int, Range(ge=2, le=MOST)] = 200
    landmarks: Count = 60
    unnamed: Flag = False


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
    from rbpf.sensors.readers.images.part import Part

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
