"""Recognises the format of a recording and opens it: a new format needs one file, and one line here."""

import logging
from pathlib import Path

from rbpf.errors import InputError
from rbpf.sensors.readers.format import Format, recognised
from rbpf.sensors.readers.images.bag import RosBag
from rbpf.sensors.readers.images.euroc import Euroc
from rbpf.sensors.readers.images.folders import Folder, Photos, SevenScenes, Tum
from rbpf.sensors.readers.images.kitti import Kitti
from rbpf.sensors.readers.images.sequence import TOLERANCE_S, UNNAMED, ImageFormat, ImageSequence, ReadOptions, Topics
from rbpf.sensors.readers.images.video import Video
from rbpf.sensors.readers.mrclam import Mrclam
from rbpf.sensors.readers.mrpt import Mrpt
from rbpf.sensors.readers.part import WHOLE, Part
from rbpf.sensors.readers.robot_log import LogNoise, RobotLog
from rbpf.sensors.readers.victoria_park import VictoriaPark

#: Formats in order; the first that recognises a recording reads it.
ROBOT_LOGS: tuple[Format[LogNoise, RobotLog], ...] = (Mrpt(), Mrclam(), VictoriaPark())
IMAGES: tuple[ImageFormat, ...] = (RosBag(), Tum(), Euroc(), Kitti(), SevenScenes(), Photos(), Video(), Folder())
_log = logging.getLogger(__name__)


def open_log(path: str | Path, noise: LogNoise | None = None) -> RobotLog:
    """Read a robot log, a folder or a file, of any known format, which the modules of the readers describe.

    `noise` has standard deviations that replace the log's. Raises InputError: the path does not exist, is of no known
    format, or has a malformed file.
    """
    path, found = recognised(path, ROBOT_LOGS, "a robot log")
    return found.read(path, noise or LogNoise())


def open_images(
    path: str | Path, calibration: str | Path | None = None, topics: Topics = UNNAMED, part: Part = WHOLE
) -> ImageSequence:
    """Open the images of one camera, of two cameras the left one, in any known format: a folder, a video, or a ROS bag.

    Args:
        path: of the sequence; only its first image is decoded.
        calibration: a `camera.yaml` to use in place of the sequence's own camera.
        topics: of a ROS bag, if they have to be named.
        part: which of its images, and in which size.

    Raises InputError: the path does not exist, is of no known format, has no readable image, or another of its files is
    malformed; a named topic does not exist.
    """
    return _opened(path, ReadOptions(None if calibration is None else Path(calibration), topics), part)


def open_stereo(
    path: str | Path,
    calibration: str | Path | None = None,
    tolerance_s: float = TOLERANCE_S,
    topics: Topics = UNNAMED,
    part: Part = WHOLE,
) -> ImageSequence:
    """Open the images of two cameras side by side: EuRoC ASL (`cam0`, `cam1`), KITTI (`image_0`, `image_1`), ROS bags.

    Images of EuRoC and of bags are paired by their times; those without a partner are left out, with an entry in `notes`.
    Unrectified images are rectified by the two `sensor.yaml` or CameraInfo; the truth is then that of the rectified left
    camera. KITTI's images are rectified and numbered: one that is missing on either side gives a pair with a problem.

    Args:
        path: its folder, or a ROS bag.
        calibration: a `camera.yaml` of the rectified left camera, in place of the sequence's own calibration; with
            `baseline_m`, in place of its baseline, too.
        tolerance_s: largest time difference of two images that form a pair.
        topics: as of `open_images`.
        part: likewise.

    Raises InputError: as of `open_images`, no two images form a pair, the two cameras' images differ in size, the
    baseline is zero, or the right camera is not to the right of the left one.
    """
    options = ReadOptions(None if calibration is None else Path(calibration), topics, tolerance_s, stereo=True)
    return _opened(path, options, part)


def _opened(path: str | Path, options: ReadOptions, part: Part) -> ImageSequence:
    what, kind = ("a stereo sequence", "stereo_kind") if options.stereo else ("an image sequence", "kind")
    path, found = recognised(path, [one for one in IMAGES if getattr(one, kind)], what, kind)
    if not found.has_topics and (given := options.topics.entries()):
        name, value = next(iter(given.items()))
        problem = f"{name.replace('_', ' ')} {value} is given, but only ROS bags have topics"
        raise InputError(f"{path}: {problem}; leave it out.")
    sequence = found.read(path, options)
    for note in sequence.notes:
        _log.warning("%s", note)
    return sequence if part == WHOLE else part.apply(sequence)
