"""ROS bags of two cameras: pairs of images, rectified where they are not.

The left topic comes first; where none is named, the two that there are, in alphabetical order (`cam0` and `cam1`,
`left` and `right`). Their CameraInfo says by R and P where the cameras are, as `camera_calibration` leaves it; with a
`camera.yaml` the images are taken as rectified, and its `baseline_m` as the cameras' distance.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.readers.images.bag import chosen
from rbpf.sensors.readers.images.bag_camera import CameraInfo, read_info
from rbpf.sensors.readers.images.bag_file import Bag, opened
from rbpf.sensors.readers.images.bag_frames import BagImages, ImageStream, read_stream
from rbpf.sensors.readers.images.bag_poses import read_poses
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.sensors.readers.images.euroc_camera import AslCamera
from rbpf.sensors.readers.images.euroc_pair import Pair
from rbpf.sensors.readers.images.euroc_stereo import rectified_baseline
from rbpf.sensors.readers.images.pairing import pair_stamps
from rbpf.sensors.readers.images.rectification import Rectification, RectifiedImages
from rbpf.sensors.readers.images.sequence import ImageSequence, Source
from rbpf.sensors.readers.images.topics import Topics

PAIR_KIND = "a ROS bag with two topics of images"


def read(path: Path, calibration: Path | None, tolerance_s: float, topics: Topics) -> Pair:
    """Open the bag; arguments and errors as of `open_stereo`."""
    with opened(path) as bag:
        names = chosen(bag, topics, 2)
        streams = [read_stream(bag, name) for name in names]
        where = f"{path}, {' and '.join(names)}"
        _require_one_size(where, streams)
        rig, rectification = (
            _told(bag, streams) if calibration is None else (_given(calibration, streams), None)
        )
        left, right, notes = pair_stamps(streams[0].stamps_ns, streams[1].stamps_ns, tolerance_s, where)
        stamps_ns = streams[0].stamps_ns[left]
        truth = topics.truth and read_poses(bag, topics.truth, stamps_ns, streams[0].frame)
    source: Source = BagImages(path, stamps_ns, streams[0].shape, tuple(names), (left, right))
    if rectification is not None:
        source = RectifiedImages(source, rectification)
        notes += (f"{path}: the two cameras are not rectified; their images are, by the two CameraInfo.",)
    if truth and rectification is not None:
        turned = SE3.compose(truth.world_from_camera, rectification.left_from_rectified)
        truth = replace(truth, world_from_camera=turned)
    return ImageSequence(bag.name, rig.camera, stamps_ns, truth or None, rig.baseline_m, source), rig, notes


def _require_one_size(where: str, streams: list[ImageStream]) -> None:
    left, right = (f"{stream.shape[1]}x{stream.shape[0]}" for stream in streams)
    if left != right:
        raise InputError(f"{where}: the images have {left} and {right} px, expected one size.")


def _given(calibration: Path, streams: list[ImageStream]) -> RectifiedStereo:
    """The rectified pair of a camera.yaml."""
    used = read_calibration(calibration)
    used.require_shape(streams[0].shape, streams[0].topic)
    if used.baseline_m is None:
        raise InputError(f"{calibration}: expected baseline_m, the distance of the two cameras in m.")
    return RectifiedStereo(used.camera, used.baseline_m)


def _told(bag: Bag, streams: list[ImageStream]) -> tuple[RectifiedStereo, Rectification | None]:
    """The pair of two CameraInfo, and how its images are rectified, None where they are."""
    left, right = (read_info(bag, stream.topic) for stream in streams)
    for info, stream in ((left, streams[0]), (right, streams[1])):
        info.calibration.require_shape(stream.shape, f"{bag.path}, {stream.topic}")
    if left.is_rectified != right.is_rectified:
        topics = " and ".join(stream.topic for stream in streams)
        raise InputError(
            f"{bag.path}: of {topics} one is rectified and the other is not; give two of a kind."
        )
    apart = right.shift_m - left.shift_m
    if apart <= 0.0:
        problem = f"P puts the right camera {apart:g} m to the right of the left one"
        action = "exchange the topics (--image-topic LEFT,RIGHT), or calibrate the two as a pair"
        raise InputError(f"{right.calibration.where}: {problem}; {action}.")
    if left.is_rectified and right.is_rectified:
        return RectifiedStereo(left.calibration.camera, apart), None
    left_from_right = _between(left, right, apart)
    baseline_m = rectified_baseline(
        AslCamera(left.calibration, SE3.identity()), AslCamera(right.calibration, left_from_right)
    )
    if baseline_m is not None:
        return RectifiedStereo(left.calibration.camera, baseline_m), None
    cameras = left.calibration.camera, right.calibration.camera
    rectification = Rectification.between(*cameras, left_from_right, right.calibration.where)
    return rectification.rig, rectification


def _between(left: CameraInfo, right: CameraInfo, apart: float) -> Array:
    """Pose (7,) of the right camera in the frame of the left one, by way of the rectified frames."""
    aside = np.array([0.0, 0.0, 0.0, 1.0, apart, 0.0, 0.0])
    return SE3.compose(
        SE3.inverse(left.rectified_from_camera()), SE3.compose(aside, right.rectified_from_camera())
    )
