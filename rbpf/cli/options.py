"""The options of the commands; their docstrings are the help texts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rbpf.errors import InputError
from rbpf.sensors.chessboard import Board


@dataclass(frozen=True)
class RangeBearingOptions:
    """Options of `rbpf run range-bearing`.

    Attributes:
        log: recording: a folder of an MRCLAM or MRPT log, or a Victoria Park graph.
        out: folder for the results.
        particles: number of particles; by default as in the configuration.
        seed: of the random generator; by default as in the configuration.
        association: landmarks named by the log, or by maximum likelihood; by default as in the configuration.
        config: YAML file of settings, such as a former run's config.yaml.
        set: a setting as key=value, such as proposal.iterations=1 or noise.std_range_m=0.1.
        resume: go on from the checkpoint in the results' folder.
        batch: also solve for the batch optimum with GTSAM.
        threads: threads of the kernels; by default all.
    """

    log: tyro.conf.Positional[Path]
    out: Path = Path("run")
    particles: int | None = None
    seed: int | None = None
    association: Literal["known", "ml"] | None = None
    config: Path | None = None
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    batch: bool = True
    threads: int | None = None


@dataclass(frozen=True)
class MonoOptions:
    """Options of `rbpf run mono`.

    Attributes:
        sequence: images: a folder of a known kind (EuRoC, TUM RGB-D, KITTI, 7-Scenes, images with a camera.yaml) or
            a video with a camera.yaml beside it.
        known_points: table of points of known position that are seen in the first image; without it the world is
            the first camera's and its scale is arbitrary.
        board: in place of known points, inner corners of a chessboard that is seen whole in the first image, as 9x6;
            the world is then the board's.
        square: side of its squares, m.
        calibration: camera.yaml in place of the sequence's own.
        out: folder for the results.
        particles: number of particles; by default as in the configuration.
        seed: of the random generator; by default as in the configuration.
        config: YAML file of settings, such as a former run's config.yaml.
        set: a setting as key=value, such as search.measurements=30 or ray.constrain=epipolar.
        resume: go on from the checkpoint in the results' folder.
        rerun: also write a recording (.rrd) for the Rerun viewer.
        video: write the annotated video.
        batch: also adjust the same measurements in batch with GTSAM.
        batch_limit: seconds after which the batch adjustment is given up; the run's results stay.
        threads: threads of the kernels; by default all.
    """

    sequence: tyro.conf.Positional[Path]
    known_points: Path | None = None
    board: str | None = None
    square: float | None = None
    calibration: Path | None = None
    out: Path = Path("run")
    particles: int | None = None
    seed: int | None = None
    config: Path | None = None
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    rerun: Path | None = None
    video: bool = True
    batch: bool = True
    batch_limit: float = 300.0
    threads: int | None = None


@dataclass(frozen=True)
class StereoOptions:
    """Options of `rbpf run stereo`.

    Attributes:
        sequence: images of a rectified pair, or of one that its calibration rectifies: a folder of EuRoC ASL with cam0
            and cam1, or of KITTI odometry with image_0 and image_1.
        calibration: camera.yaml in place of the sequence's own.
        out: folder for the results.
        particles: number of particles; by default as in the configuration.
        dof: degrees of freedom of the camera: 6, or 3 in its x-z plane; by default as in the configuration.
        seed: of the random generators; by default as in the configuration.
        config: YAML file of settings, such as a former run's config.yaml.
        set: a setting as key=value, such as proposal.kind=ekf or sift.length=128.
        resume: go on from the checkpoint in the results' folder.
        video: write the annotated video.
        rerun: also write a recording (.rrd) for the Rerun viewer.
        threads: threads of the kernels; by default all.
    """

    sequence: tyro.conf.Positional[Path]
    calibration: Path | None = None
    out: Path = Path("run")
    particles: int | None = None
    dof: Literal[3, 6] | None = None
    seed: int | None = None
    config: Path | None = None
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    video: bool = True
    rerun: Path | None = None
    threads: int | None = None


@dataclass(frozen=True)
class ImagesOptions:
    """Options of `rbpf simulate desk` and `rbpf simulate room`.

    Attributes:
        out: folder for the sequence (EuRoC ASL, with camera.yaml and known_points.csv); must not exist, or be empty.
        seed: of the random generator.
        frames: number of images, 30 per second.
        width: of the images, px.
        height: of the images, px.
        focal_px: focal length; by default 0.8 of the width.
        distortion: k1, k2, p1, p2, k3 of the lens.
        baseline_m: of a second camera to the right; by default there is none.
        known: corners in the first image whose positions are given, at least 4; 0 for none.
        noise_std: of the sensor, grey levels.
        blur_s: the shutter is open this long.
        exposure_drift: greatest change of the exposure, as a share.
        vignetting: share of the light that is missing in the corners.
        contrast: of all textures; 1 is rich, 0.1 poor.
        blackout: first frame in the dark and number of frames.
        depth: also write depth images.
        jpeg: quality of JPEG files, 1 to 100; 0 writes PNG, which loses nothing.
        board: a chessboard of so many inner corners lies on the desk, as 9x6.
        square: side of its squares, m.
    """

    out: Path
    seed: int = 0
    frames: int = 300
    width: int = 640
    height: int = 480
    focal_px: float | None = None
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    baseline_m: float | None = None
    known: int = 6
    noise_std: float = 3.0
    blur_s: float = 0.01
    exposure_drift: float = 0.15
    vignetting: float = 0.2
    contrast: float = 1.0
    blackout: tuple[int, int] | None = None
    depth: tyro.conf.FlagCreatePairsOff[bool] = False
    jpeg: int = 0
    board: str | None = None
    square: float | None = None


@dataclass(frozen=True)
class LabOptions:
    """Options of `rbpf simulate lab`.

    Attributes:
        out: folder for the sequence (EuRoC ASL, with camera.yaml, known_points.csv and odometry.csv); must not exist,
            or be empty.
        seed: of the random generator.
        trajectory: a tour of 4,000 images over 68 m through both rooms and back, or 600 images on which the robot twice
            looks away for 5 s and back.
        frames: only so many images, the first; by default all.
        every: only each so many-th frame becomes an image.
        width: of the images, px.
        height: of the images, px.
        focal_px: focal length; by default 0.78125 of the width, 500 px at 640.
        distortion: k1, k2, p1, p2, k3 of the lens; none where there are two cameras.
        baseline_m: of the second camera, to the right; None for none.
        known: corners in the first image whose positions are given, at least 4; 0 for none.
        noise_std: of the sensor, grey levels; by default as in dim light.
        blur_s: the shutter is open this long.
        exposure_drift: greatest change of the exposure, as a share.
        vignetting: share of the light that is missing in the corners.
        contrast: of all textures; 1 is rich, 0.1 poor.
        blackout: first frame in the dark and number of frames.
        depth: also write depth images.
        jpeg: quality of JPEG files, 1 to 100; 0 writes PNG, which loses nothing.
        texel_m: side of a texel; larger ones are drawn sooner.
    """

    out: Path
    seed: int = 0
    trajectory: Literal["tour", "turn_back"] = "tour"
    frames: int | None = None
    every: int = 1
    width: int = 640
    height: int = 480
    focal_px: float | None = None
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    baseline_m: float | None = 0.12
    known: int = 6
    noise_std: float = 8.0
    blur_s: float = 0.0
    exposure_drift: float = 0.0
    vignetting: float = 0.0
    contrast: float = 1.0
    blackout: tuple[int, int] | None = None
    depth: tyro.conf.FlagCreatePairsOff[bool] = False
    jpeg: int = 0
    texel_m: float = 0.003


def given_board(size: str | None, square_m: float | None) -> Board | None:
    """The chessboard of `--board` and `--square`.

    Raises:
        InputError: one of the two is missing or makes no sense.
    """
    if size is None and square_m is None:
        return None
    if size is None or square_m is None:
        raise InputError(
            "a chessboard needs both its inner corners and the side of its squares: --board 9x6 --square 0.024"
        )
    return Board.parse(size, square_m)
