"""ROS bags of one camera or two: `.bag` of ROS 1, and of ROS 2 a folder with `metadata.yaml`, `.mcap` or `.db3`.

- The images: a topic of sensor_msgs Image or CompressedImage; if there are several, one has to be named. For stereo two,
  the left topic first; by default the bag's only two, in alphabetical order (`cam0` and `cam1`, `left` and `right`).
  Encodings are those of `sensor_msgs/image_encodings`: grey and colour of 8 bits, grey of 16, and the Bayer patterns. The
  size that a message claims is checked against its bytes before it is decoded.
- The camera: sensor_msgs CameraInfo beside it (`/cam0/camera_info` for `/cam0/image_raw`), its K, D and size, or a
  `camera.yaml`. If the last part of the topic's name marks the images as rectified (`image_rect`, `image_rect_color`; a bag
  has no other mark), the camera is that of P, without distortion. R and P give the relative pose of two cameras, as
  `camera_calibration` writes them; with a `camera.yaml` the images are taken as rectified, and its `baseline_m` as the
  baseline.
- The truth: a topic of geometry_msgs PoseStamped, PoseWithCovarianceStamped, TransformStamped or nav_msgs Odometry, if one
  is named. The poses are taken as world_from_camera, of the camera's optical frame (x to the right, y down, z ahead). A bag
  with poses of another frame, such as `base_link`, has to be converted first; a logged message warns if the frame names
  show it.

Times are those of the messages' headers. A bag's index does not have them: the topic is read once when it is opened. A
message too damaged to have a time is left out; one that has a time but no valid image is a frame with a `problem`; a bag
with a damaged end is read up to there.

The library `rosbags` reads the containers. The messages have one standard definition per ROS version, which the library
provides: definitions in a bag are never compiled, so that no code from a bag runs.
"""

import bz2
import logging
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.images.calibration import Calibration, read_calibration
from rbpf.sensors.readers.images.decoding import Grey, decode, decode_ahead, frame_of, require_shape, to_grey
from rbpf.sensors.readers.images.poses import normalised, pose_of_matrix, truth_between
from rbpf.sensors.readers.images.rectification import pair_stamps, rectified
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageFrame, ImageSequence, ReadOptions, Source

SUFFIXES = frozenset({".bag", ".mcap", ".db3"})

MOST_BYTES = 1 << 30  #: Largest accepted size of an unpacked chunk.
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

#: The stamp of a message with a header, in both versions of ROS: seconds and nanoseconds after four bytes.
_LITTLE, _BIG = Struct("<4xII"), Struct(">4xII")
_LAYOUTS = {
    "mono8": (1, np.uint8, None),
    "8UC1": (1, np.uint8, None),
    "mono16": (1, np.uint16, None),
    "bgr8": (3, np.uint8, "COLOR_BGR2GRAY"),
    "rgb8": (3, np.uint8, "COLOR_RGB2GRAY"),
    "bgra8": (4, np.uint8, "COLOR_BGRA2GRAY"),
    "rgba8": (4, np.uint8, "COLOR_RGBA2GRAY"),
    **{
        f"bayer_{pattern}{bits}": (1, kind, f"COLOR_Bayer{pattern.upper()}2GRAY")
        for pattern in ("rggb", "bggr", "gbrg", "grbg")
        for bits, kind in ((8, np.uint8), (16, np.uint16))
    },
}  #: Encoding to channels, data type, and OpenCV's conversion to grey, None if it is grey.
#: Distortion models that begin with k1, k2, p1, p2, k3; further coefficients of the second one must be zero.
_RADIAL_TANGENTIAL = "plumb_bob", "rational_polynomial"
_EQUIDISTANT = "equidistant", "fisheye"  #: Models with k1, k2, k3, k4: ROS's name and OpenCV's.
_POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
}  #: The field of a message that holds its pose.
#: A message of ROS 1 that the library does not define: its definition and its name.
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
_log = logging.getLogger(__name__)


class RawMessage(NamedTuple):
    """A serialised message: its type such as sensor_msgs/msg/Image, its bytes, the time of its header."""

    type: str
    data: bytes
    stamp_ns: int


@final
class Bag:
    """An open bag, with the library's reader and the types of the bag's ROS version."""

    def __init__(self, path: Path, reader: Any, types: Any) -> None:
        self.path = path
        self._reader, self._types = reader, types
        self._ros1 = path.suffix == ".bag" and path.is_file()
        # A file without a summary reports a count of zero for every topic.
        counted = any(c.msgcount for c in reader.connections)
        #: Types of the topics with messages, by name.
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in reader.connections if c.msgcount or not counted}

    def of_type(self, *types: str) -> list[str]:
        """Topics of some types, in alphabetical order."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def messages(self, topic: str, headed: bool = True) -> Iterator[RawMessage]:
        """Messages of a topic in the order of the bag, without those too damaged to have a time.

        Messages without a header (`headed` is False) get the time at which the bag recorded them.
        """
        chosen = [c for c in self._reader.connections if c.topic == topic]
        with _refusing(self.path), closing(self._reader.messages(connections=chosen)) as found:
            for connection, received_ns, data in found:
                if not headed:
                    yield RawMessage(connection.msgtype, data, received_ns)
                    continue
                layout = _LITTLE if self._ros1 or data[1:2] == b"\x01" else _BIG
                if len(data) < layout.size:
                    continue
                seconds, nanoseconds = layout.unpack_from(data)
                if nanoseconds < 10**9:
                    yield RawMessage(connection.msgtype, data, int(seconds) * 10**9 + int(nanoseconds))

    def message(self, raw: RawMessage) -> Any:
        """The message deserialised."""
        read = self._types.deserialize_ros1 if self._ros1 else self._types.deserialize_cdr
        with _refusing(self.path):
            return read(raw.data, raw.type)


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """A bag, closed at the end."""
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        problem = "a ROS bag is read with the package rosbags, which is not installed"
        raise InputError(f"{path}: {problem}: pip install 'rbpf[bags]'") from None
    ros1 = path.suffix == ".bag" and path.is_file()
    with _refusing(path):
        reader: Any = rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)
        reader.open()
    try:
        types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
        if ros1:
            types.register(get_types_from_msg(*_TRANSFORMS))
            # Limits the unpacked size of chunks to `MOST_BYTES`; the library itself has no limit.
            for place, chunk in reader.chunks.items():
                if chunk.datasize > MOST_BYTES:
                    raise InputError(f"{path}: a chunk claims to be larger than {MOST_BYTES >> 20} MiB.")
                reader.chunks[place] = chunk._replace(decompressor=partial(_unpacked, chunk.decompressor))
        yield Bag(path, reader, types)
    finally:
        reader.close()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turns all exceptions on damaged bytes, assertions of the library included, into one InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join((str(error) or type(error).__name__).split())[:200].rstrip(".")
        action = "copy it again, or repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
        raise InputError(f"{path}: the bag cannot be read ({reason}); {action}.") from None


def _unpacked(unpack: Callable[[bytes], bytes], data: bytes) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    decompressor: Any
    if data.startswith(b"BZh"):
        decompressor = bz2.BZ2Decompressor()
    elif data.startswith(b"\x04\x22\x4d\x18"):
        decompressor = LZ4FrameDecompressor()
    else:
        return unpack(data)
    unpacked = decompressor.decompress(data, MOST_BYTES)
    if not decompressor.eof:
        raise ValueError(f"a chunk is cut off, or larger than {MOST_BYTES >> 20} MiB")
    return bytes(unpacked)


def read_image(bag: Bag, raw: RawMessage, where: str, shape: tuple[int, int] | None = None) -> Grey:
    """Image (H, W) of a message; `where` is for error messages, `shape` the required height and width.

    Raises InputError: it is damaged, of an encoding that is not known, or of another size.
    """
    try:
        message = bag.message(raw)
    except InputError:
        raise InputError(f"{where}: a message is damaged.") from None
    return image_of(message, where, shape)


def image_of(message: Any, where: str, shape: tuple[int, int] | None = None) -> Grey:
    """Image (H, W) of an Image or a CompressedImage; arguments and errors as of `read_image`."""
    import cv2

    data = np.asarray(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        return decode(where, data, shape)
    if message.encoding not in _LAYOUTS:
        known = ", ".join(_LAYOUTS)
        raise InputError(f"{where}: the encoding {message.encoding[:40]!r} is none of {known}; convert it.")
    channels, kind, conversion = _LAYOUTS[message.encoding]
    width = message.width * channels * np.dtype(kind).itemsize
    if not (message.height > 0 and 0 < width <= message.step):
        raise InputError(f"{where}: {message.width}x{message.height} px in rows of {message.step} bytes.")
    if message.height * message.step != len(data):
        expected = f"expected {message.height} rows of {message.step} bytes"
        raise InputError(f"{where}: {expected}, found {len(data)} bytes.")
    rows = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :width])
    pixels = rows.view(np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")).astype(kind)
    if channels > 1:
        pixels = pixels.reshape(message.height, message.width, channels)
    if conversion is not None:
        pixels = np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)))
    return require_shape(where, to_grey(where, pixels), shape)


@dataclass(frozen=True)
class CameraInfo:
    """A camera as described by CameraInfo messages."""

    calibration: Calibration  #: the camera of the images in the bag.
    rotation: Array  #: (3, 3) R, which rectifies the pair that it belongs to.
    projection: Array  #: (3, 4) P, of the camera after that rotation; its last column holds the baseline.
    is_rectified: bool  #: whether the images are already rectified by R.

    @classmethod
    def read(cls, bag: Bag, image_topic: str) -> "CameraInfo":
        """The camera of an image topic, from its first CameraInfo message."""
        named = image_topic.removesuffix("/compressed")
        topic = f"{named.rpartition('/')[0]}/camera_info"
        held = bag.of_type(CAMERA_INFO)
        if topic not in held:
            found = f"found {', '.join(held)}" if held else "found no sensor_msgs/CameraInfo"
            raise InputError(
                f"{bag.path}: expected the camera of {image_topic} in {topic}, {found}; give --calibration camera.yaml."
            )
        where = f"{bag.path}, {topic}"
        raw = next(bag.messages(topic), None)
        if raw is None:
            raise InputError(f"{where}: no message can be read.")
        return cls.of(bag.message(raw), where, named.rpartition("/")[2].startswith("image_rect"))

    @classmethod
    def of(cls, message: Any, where: str, is_rectified: bool) -> "CameraInfo":
        """The camera of a CameraInfo message; `where` is for error messages."""
        roi = message.roi
        if max(message.binning_x, message.binning_y) > 1 or roi.x_offset or roi.y_offset:
            problem = "the images are binned or a part of the sensor's, which K does not describe"
            raise InputError(f"{where}: {problem}; give --calibration with the camera of these images.")
        rotation, projection = _field(message, "R").reshape(3, 3), _field(message, "P").reshape(3, 4)
        intrinsics = projection[:, :3] if is_rectified else _field(message, "K").reshape(3, 3)
        fx, fy, cx, cy = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        if not (np.isfinite(intrinsics).all() and fx > 0.0 and fy > 0.0):
            raise InputError(f"{where}: the camera is not calibrated (fx {fx:g}, fy {fy:g}); give --calibration.")
        # The model of distortion and its coefficients.
        d, model = _field(message, "D").tolist(), message.distortion_model
        lens: dict[str, Any] = {}
        if not is_rectified:
            if model in _EQUIDISTANT and len(d) == 4:
                lens = {"distortion_model": "equidistant", "distortion": tuple(d)}
            elif (model in _RADIAL_TANGENTIAL or not (model or any(d))) and not any(d[5:]):
                lens = {"distortion": (*d[:5], *[0.0] * 5)[:5]}
            else:
                problem = f"the lens is {model[:40]!r} with {len(d)} coefficients"
                expected = "expected plumb_bob with 4 or 5, or equidistant with 4"
                raise InputError(f"{where}: {problem}, {expected}; rectify the images, or give --calibration.")
        try:
            camera = Pinhole(message.width, message.height, fx, fy, cx, cy, **lens)
        except InputError as error:
            raise InputError(f"{where}: {error}; give --calibration.") from None
        return cls(Calibration(where, camera), rotation, projection, is_rectified)

    @property
    def shift_m(self) -> float:
        """Offset to the right of the pair's left camera after rectification; 0 if P has none."""
        fx, shift = self.projection[0, [0, 3]]
        return float(-shift / fx) if fx > 0.0 and np.isfinite(shift) else 0.0


def _field(message: Any, name: str) -> Array:
    """A numeric field that has an upper-case name in ROS 1 and a lower-case one in ROS 2."""
    return np.array(getattr(message, name if hasattr(message, name) else name.lower()), np.float64)


def numbers_of(pose: Any) -> Array:
    """[qx, qy, qz, qw, x, y, z] of a Pose or Transform message."""
    turn, place = (pose.orientation, pose.position) if hasattr(pose, "position") else (pose.rotation, pose.translation)
    return np.array([turn.x, turn.y, turn.z, turn.w, place.x, place.y, place.z], dtype=float)


def read_poses(bag: Bag, topic: str, images_ns: np.ndarray, camera_frame: str) -> Truth:
    """Ground truth from a topic, for images at (T,) times; warns if the poses are not of `camera_frame`."""
    kind = bag.topics.get(topic, "")
    if kind not in _POSES:
        held = bag.of_type(*_POSES)
        found = f"found {', '.join(held)}" if held else "found none"
        raise InputError(f"{bag.path}: expected poses in the topic {topic}, {found} with poses in the bag.")
    where = f"{bag.path}, {topic}"
    stamps, poses = list[int](), list[Array]()
    for raw in bag.messages(topic):
        message = bag.message(raw)
        frame = getattr(message, "child_frame_id", "")
        if not poses and frame and camera_frame and frame.strip("/") != camera_frame.strip("/"):
            _log.warning(
                "%s: the poses of %s are those of %s and are taken as those of the camera %s",
                bag.path, topic, frame, camera_frame,
            )  # fmt: skip
        stamps.append(raw.stamp_ns)
        poses.append(numbers_of(attrgetter(_POSES[kind])(message)))
    if not poses:
        raise InputError(f"{where}: no pose can be read.")
    stamps_ns = np.array(stamps, np.int64)
    if (late := np.flatnonzero(np.diff(stamps_ns) < 0)).size:
        raise InputError(f"{where}: the stamp of pose {late[0] + 1} is before the one it follows.")
    world_from_camera = normalised(np.array(poses), lambda row, what: InputError(f"{where}, pose {row}: {what}."))
    return truth_between(bag.path, stamps_ns, world_from_camera, images_ns)


@final
class RosBag(ImageFormat):
    """ROS bags of one camera or two."""

    kind = "a ROS bag (.bag, .mcap, .db3, or a folder with metadata.yaml)"
    stereo_kind = "a ROS bag with two topics of images"
    has_topics = True

    def recognises(self, path: Path) -> bool:
        if path.is_file():
            return path.suffix in SUFFIXES
        return (path / "metadata.yaml").is_file() and any(SUFFIXES & set(file.suffixes) for file in path.iterdir())

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        topics, cameras = options.topics, 2 if options.stereo else 1
        with opened(path) as bag:
            # The named image topics, or all of the bag; as many as cameras are required.
            held, named = bag.of_type(IMAGE, COMPRESSED), topics.images[:cameras]
            found = f"the bag's image topics are {', '.join(held)}" if held else "the bag has no topic of images"
            if missing := [topic for topic in named if topic not in held]:
                raise InputError(f"{path}: {missing[0]} is no topic of images; {found}.")
            names = list(named) or held
            if len(names) != cameras:
                what = "one of them with --image-topic" if cameras == 1 else "two of them with --image-topic LEFT,RIGHT"
                raise InputError(f"{path}: {found}; name {what}." if held else f"{path}: {found}.")
            # The cameras, from a file or the bag.
            if options.calibration is None:
                infos = [CameraInfo.read(bag, name) for name in names]
                used = infos[0].calibration
            else:
                infos, used = [], read_calibration(options.calibration)
            stamps, shapes, frames = zip(*[_stamps_and_first(bag, name) for name in names], strict=True)
            shape, where = shapes[0], f"{path}, {' and '.join(names)}"
            sizes = [f"{width}x{height}" for height, width in shapes]
            if sizes[0] != sizes[-1]:
                raise InputError(f"{where}: the images have {sizes[0]} and {sizes[1]} px, expected one size.")
            for name, calibration in zip(names, [info.calibration for info in infos] or [used], strict=False):
                calibration.require_shape(shape, f"{path}, {name}")
            rows, notes = [np.arange(len(stamps[0]))], tuple[str, ...]()
            if cameras == 2:
                *rows, notes = pair_stamps(stamps[0], stamps[1], options.tolerance_s, where)
            stamps_ns = stamps[0][rows[0]]
            truth = topics.truth and read_poses(bag, topics.truth, stamps_ns, frames[0])
        source = BagImages(path, stamps_ns, shape, tuple(names), tuple(rows))
        whole = path.resolve()
        name = whole.stem if whole.is_file() else whole.name
        sequence = ImageSequence(name, used.camera, stamps_ns, truth or None, None, source, notes)
        if cameras == 1:
            return sequence
        if not infos:
            if used.baseline_m is None:
                raise InputError(f"{options.calibration}: expected baseline_m, the distance of the two cameras in m.")
            return replace(sequence, baseline_m=used.baseline_m)
        left, right = infos
        if left.is_rectified != right.is_rectified:
            both = " and ".join(names)
            raise InputError(f"{path}: of {both} one is rectified and the other is not; choose two of a kind.")
        apart_m, where = right.shift_m - left.shift_m, right.calibration.where
        if apart_m <= 0.0:
            problem = f"P puts the right camera {apart_m:g} m to the right of the left one"
            action = "exchange the topics (--image-topic LEFT,RIGHT), or calibrate the two as a pair"
            raise InputError(f"{where}: {problem}; {action}.")
        if left.is_rectified:
            return replace(sequence, baseline_m=apart_m)

        def turn(info: CameraInfo) -> Array:
            wrong = InputError(f"{info.calibration.where}: R is no rotation; calibrate the two as a pair.")
            return pose_of_matrix(np.column_stack([info.rotation, np.zeros(3)]), lambda _: wrong)

        # left_from_right, composed from the two rectifying rotations and the baseline.
        aside = np.array([0.0, 0.0, 0.0, 1.0, apart_m, 0.0, 0.0])
        left_from_right = SE3.compose(SE3.inverse(turn(left)), SE3.compose(aside, turn(right)))
        note = f"{path}: the two cameras are not rectified; their images are, by the two CameraInfo."
        return rectified(sequence, right.calibration.camera, left_from_right, where, note)


def _stamps_and_first(bag: Bag, topic: str) -> tuple[np.ndarray, tuple[int, int], str]:
    """Header times (T,) of an image topic, not decreasing; height and width, and the name of the camera frame.

    The last two are those of the first image that can be read.
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
                except InputError as error:
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
        raise InputError(f"{where}: {alike}, their headers have not been set.")
    return stamps_ns, *first


@final
@dataclass(frozen=True)
class BagImages(Source):
    """Images of one topic, or pairs of two topics, left first, of height and width `shape`, at times (T,).

    `rows` (T,) are, for each topic, the increasing indices of the messages used.
    """

    path: Path
    stamps_ns: np.ndarray
    shape: tuple[int, int]
    topics: tuple[str, ...]
    rows: tuple[np.ndarray, ...]

    def frames(self, start: int) -> Generator[ImageFrame]:
        with ExitStack() as stack:
            # One reader per topic, as a bag may store all left images before all right ones.
            streams = [
                self._stream(stack.enter_context(opened(self.path)), topic, rows[start:])
                for topic, rows in zip(self.topics, self.rows, strict=True)
            ]
            for stream in streams:
                stack.callback(stream.close)

            def load(index: int) -> ImageFrame:
                return frame_of(self.stamps_ns[index], *(partial(self._next, stream) for stream in streams))

            with closing(decode_ahead(load, range(start, len(self.stamps_ns)))) as frames:
                yield from frames

    def _stream(self, bag: Bag, topic: str, rows: np.ndarray) -> Generator[Callable[[], Grey]]:
        """Yields for each selected message of a topic a function that decodes its image."""
        wanted = frozenset(rows.tolist())
        for number, raw in enumerate(bag.messages(topic)):
            if number in wanted:
                yield partial(read_image, bag, raw, f"{bag.path}, {topic}, image {number}", self.shape)

    def _next(self, stream: Generator[Callable[[], Grey]]) -> Grey:
        read = next(stream, None)
        if read is None:
            raise InputError(f"{self.path}: the bag has changed and ends before.")
        return read()
