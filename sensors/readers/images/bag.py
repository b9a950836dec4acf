"""ROS bags of one camera or two: `.bag` of ROS 1, and of ROS 2 a folder with `metadata.yaml`, `.mcap` or `.db3`.

- the images: a topic of sensor_msgs Image or CompressedImage; where there are several, one has to be named. For stereo two:
  the left topic comes first; where none is named, the two that there are, in alphabetical order (`cam0` and `cam1`, `left`
  and `right`);
- the camera: sensor_msgs CameraInfo beside it (`/cam0/camera_info` for `/cam0/image_raw`), or a `camera.yaml`. Of two
  cameras R and P say where they are, as `camera_calibration` leaves it; with a `camera.yaml` the images are taken as
  rectified, and its `baseline_m` as the cameras' distance;
- the truth: a topic of poses, if one is named.

`bag_messages` says what is read of each message. Times are those of the messages' headers. A bag does not say them in its
index: the topic is gone through once as it is opened. A message that is too damaged to have a time is left out; one that
has a time, but no image, is a frame that says so; a bag that is damaged further on is read until there.
"""

import logging
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.readers.images.bag_messages import (
    COMPRESSED,
    IMAGE,
    SUFFIXES,
    Bag,
    CameraInfo,
    RawMessage,
    opened,
    read_image,
    read_poses,
)
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.sensors.readers.images.decoding import Grey, UnreadableImageError, decode_ahead, require_shape
from rbpf.sensors.readers.images.rectification import (
    Rectification,
    RectifiedImages,
    pair_stamps,
    rectified_baseline,
)
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageFrame, ImageSequence, ReadOptions, Source

_log = logging.getLogger(__name__)


@final
class RosBag(ImageFormat):
    """ROS bags of one camera or two."""

    kind = "a ROS bag (.bag, .mcap, .db3, or a folder with metadata.yaml)"
    stereo_kind = "a ROS bag with two topics of images"
    has_topics = True

    def recognises(self, path: Path) -> bool:
        if path.is_file():
            return path.suffix in SUFFIXES
        return (path / "metadata.yaml").is_file() and any(
            SUFFIXES & set(file.suffixes) for file in path.iterdir()
        )

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        topics = options.topics
        with opened(path) as bag:
            topic = _image_topics(bag, topics.images[:1], 1)[0]
            if options.calibration is None:
                used = CameraInfo.read(bag, topic).calibration
            else:
                used = read_calibration(options.calibration)
            stream = ImageStream.read(bag, topic)
            used.require_shape(stream.shape, f"{path}, {topic}")
            truth = topics.truth and read_poses(bag, topics.truth, stream.stamps_ns, stream.frame)
        rows = np.arange(len(stream.stamps_ns))
        return ImageSequence(
            name=bag.name,
            camera=used.camera,
            stamps_ns=stream.stamps_ns,
            truth=truth or None,
            baseline_m=None,
            source=BagImages(path, stream.stamps_ns, stream.shape, (topic,), (rows,)),
        )

    def read_stereo(self, path: Path, options: ReadOptions) -> ImageSequence:
        topics = options.topics
        with opened(path) as bag:
            names = _image_topics(bag, topics.images, 2)
            streams = [ImageStream.read(bag, name) for name in names]
            where = f"{path}, {' and '.join(names)}"
            sizes = [f"{stream.shape[1]}x{stream.shape[0]}" for stream in streams]
            if sizes[0] != sizes[1]:
                raise InputError(f"{where}: the images have {sizes[0]} and {sizes[1]} px, expected one size.")
            rectification: Rectification | None = None
            if options.calibration is not None:
                rig = _given_rig(options.calibration, streams)
            else:
                rig, rectification = _rig_of_infos(bag, streams)
            left, right, notes = pair_stamps(
                streams[0].stamps_ns, streams[1].stamps_ns, options.tolerance_s, where
            )
            stamps_ns = streams[0].stamps_ns[left]
            truth = topics.truth and read_poses(bag, topics.truth, stamps_ns, streams[0].frame)
        source: Source = BagImages(path, stamps_ns, streams[0].shape, tuple(names), (left, right))
        if rectification is not None:
            source = RectifiedImages(source, rectification)
            notes += (f"{path}: the two cameras are not rectified; their images are, by the two CameraInfo.",)
        if truth and rectification is not None:
            rotated = SE3.compose(truth.world_from_camera, rectification.left_from_rectified)
            truth = replace(truth, world_from_camera=rotated)
        return ImageSequence(bag.name, rig.camera, stamps_ns, truth or None, rig.baseline_m, source, notes)


@dataclass(frozen=True)
class ImageStream:
    """A topic of images.

    Attributes:
        topic: its name.
        stamps_ns: (T,) int64 times of the headers of its messages, not decreasing.
        shape: height and width of the first image that can be read.
        frame: name of the camera's frame.
    """

    topic: str
    stamps_ns: np.ndarray
    shape: tuple[int, int]
    frame: str

    @classmethod
    def read(cls, bag: Bag, topic: str) -> "ImageStream":
        """Goes through a topic once, for its times and its first image.

        Raises:
            InputError: it holds no image that can be read, or the bag is damaged, or time stands still or runs backwards.
        """
        where, stamps = f"{bag.path}, {topic}", list[int]()
        first: tuple[tuple[int, int], str] | None = None
        problems = []
        try:
            for raw in bag.messages(topic):
                stamps.append(raw.stamp_ns)
                if first is None:
                    try:
                        first = read_image(bag, raw, where).shape, bag.message(raw).header.frame_id
                    except UnreadableImageError as error:
                        problems.append(str(error))
        except InputError as error:
            if first is None:
                raise
            _log.warning("%s The %d images before it are kept.", error, len(stamps))
        if first is None:
            said = f"; the first is {problems[0]}" if problems else ""
            raise InputError(f"{where}: none of {len(stamps)} images can be read{said}")
        stamps_ns = np.array(stamps, np.int64)
        gaps = np.diff(stamps_ns)
        if (late := np.flatnonzero(gaps < 0)).size:
            raise InputError(f"{where}: the stamp of image {late[0] + 1} is before the one it follows.")
        if gaps.size and not gaps.any():
            alike = f"all {len(stamps)} images have the time {stamps_ns[0]}"
            raise InputError(f"{where}: {alike}, their headers are not filled in.")
        return cls(topic, stamps_ns, *first)


@final
@dataclass(frozen=True)
class BagImages(Source):
    """Images of one topic, or pairs of two.

    Attributes:
        path: the bag.
        stamps_ns: (T,) int64 times.
        shape: height and width that every image must have.
        topics: of the (left) camera, and of the right one if there are two.
        rows: for each topic, (T,) the number of the message that is the image, increasing.
    """

    path: Path
    stamps_ns: np.ndarray
    shape: tuple[int, int]
    topics: tuple[str, ...]
    rows: tuple[np.ndarray, ...]

    def frames(self, start: int) -> Generator[ImageFrame]:
        with ExitStack() as stack:
            # Each topic has a reader of its own: a bag may hold all left images before all right ones.
            streams = [
                self._stream(stack.enter_context(opened(self.path)), topic, rows[start:])
                for topic, rows in zip(self.topics, self.rows, strict=True)
            ]
            for stream in streams:
                stack.callback(stream.close)
            indices = range(start, len(self.stamps_ns))
            with closing(decode_ahead(lambda index: self._next(streams, index), indices)) as frames:
                yield from frames

    def _stream(self, bag: Bag, topic: str, rows: np.ndarray) -> Generator[tuple[Grey | None, str | None]]:
        """Image or problem of each of some messages of a topic."""
        wanted = iter(rows.tolist())
        row = next(wanted, None)
        for number, raw in enumerate(bag.messages(topic)):
            if number == row:
                yield self._read(bag, raw, f"{bag.path}, {topic}, image {number}")
                row = next(wanted, None)

    def _read(self, bag: Bag, raw: RawMessage, where: str) -> tuple[Grey | None, str | None]:
        try:
            return require_shape(where, read_image(bag, raw, where), self.shape), None
        except UnreadableImageError as error:
            return None, str(error)

    def _next(self, streams: list[Generator[tuple[Grey | None, str | None]]], index: int) -> ImageFrame:
        images, problem = [], None
        for stream in streams:
            try:
                image, wrong = next(stream, (None, f"{self.path}: the bag has changed and ends before."))
            except InputError as error:
                image, wrong = None, str(error)
            images.append(image)
            problem = problem or wrong
        right = images[1] if len(images) > 1 else None
        return ImageFrame(int(self.stamps_ns[index]), images[0], right, problem)


def _image_topics(bag: Bag, named: tuple[str, ...], count: int) -> list[str]:
    """The topics of images that are named, or those that there are; as many as there should be cameras, 1 or 2.

    Raises:
        InputError: a topic that is named is not there, or there are more or fewer than these and none is named.
    """
    held = bag.of_type(IMAGE, COMPRESSED)
    found = f"the bag's image topics are {', '.join(held)}" if held else "the bag has no topic of images"
    if missing := [topic for topic in named if topic not in held]:
        raise InputError(f"{bag.path}: {missing[0]} is no topic of images; {found}.")
    chosen = list(named) or held
    if len(chosen) != count:
        what = "one of them with --image-topic" if count == 1 else "two of them with --image-topic LEFT,RIGHT"
        raise InputError(f"{bag.path}: {found}; name {what}." if held else f"{bag.path}: {found}.")
    return chosen


def _given_rig(calibration: Path, streams: list[ImageStream]) -> RectifiedStereo:
    """The rectified pair of a camera.yaml."""
    used = read_calibration(calibration)
    used.require_shape(streams[0].shape, streams[0].topic)
    if used.baseline_m is None:
        raise InputError(f"{calibration}: expected baseline_m, the distance of the two cameras in m.")
    return RectifiedStereo(used.camera, used.baseline_m)


def _rig_of_infos(bag: Bag, streams: list[ImageStream]) -> tuple[RectifiedStereo, Rectification | None]:
    """The pair of two CameraInfo, and how its images are rectified, None where they are."""
    left, right = (CameraInfo.read(bag, stream.topic) for stream in streams)
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
    cameras = left.calibration.camera, right.calibration.camera
    if left.is_rectified:
        return RectifiedStereo(cameras[0], apart), None
    # The right camera in the frame of the left one, by way of the rectified frames.
    aside = np.array([0.0, 0.0, 0.0, 1.0, apart, 0.0, 0.0])
    left_from_right = SE3.compose(
        SE3.inverse(left.rectified_from_camera()), SE3.compose(aside, right.rectified_from_camera())
    )
    baseline_m = rectified_baseline(*cameras, left_from_right)
    if baseline_m is not None:
        return RectifiedStereo(cameras[0], baseline_m), None
    rectification = Rectification.between(*cameras, left_from_right, right.calibration.where)
    return rectification.rig, rectification
