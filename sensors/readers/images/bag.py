"""ROS bags of one camera: `.bag` of ROS 1, and of ROS 2 a folder with `metadata.yaml`, `.mcap` or `.db3`.

- the images: a topic of sensor_msgs Image or CompressedImage; where there are several, one has to be named;
- the camera: sensor_msgs CameraInfo beside it (`/cam0/camera_info` for `/cam0/image_raw`), or a `camera.yaml`;
- the truth: a topic of poses, if one is named (`bag_poses`).

Times are those of the messages' headers. A bag does not say them in its index: the topic is gone through once as it is
opened. A message that is too damaged to have a time is left out; one that has a time, but no image, is a frame that
says so; a bag that is damaged further on is read until there.
"""

from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.bag_camera import read_info
from rbpf.sensors.readers.images.bag_file import KIND, Bag, opened, recognises
from rbpf.sensors.readers.images.bag_frames import BagImages, image_topics, read_stream
from rbpf.sensors.readers.images.bag_poses import read_poses
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.topics import UNNAMED, Topics

__all__ = ["KIND", "chosen", "read", "recognises"]


def read(path: Path, calibration: Path | None, topics: Topics = UNNAMED) -> ImageSequence:
    """Open the bag.

    Args:
        path: file or folder.
        calibration: a camera file in place of the bag's CameraInfo.
        topics: which images and which truth; of two topics of images the first.

    Raises:
        InputError: the bag is damaged, a topic is not there or has to be named, or the camera is missing or not known.
    """
    with opened(path) as bag:
        topic = chosen(bag, Topics(topics.images[:1]), 1)[0]
        used = read_info(bag, topic).calibration if calibration is None else read_calibration(calibration)
        stream = read_stream(bag, topic)
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


def chosen(bag: Bag, topics: Topics, count: int) -> list[str]:
    """The topics of images that are named, or those that there are.

    Args:
        bag: the open bag.
        topics: what was asked for.
        count: how many cameras there should be, 1 or 2.

    Raises:
        InputError: a topic that is named is not there, or there are more or fewer than these and none is named.
    """
    held = image_topics(bag)
    found = f"the bag's image topics are {', '.join(held)}" if held else "the bag has no topic of images"
    if missing := [topic for topic in topics.images if topic not in held]:
        raise InputError(f"{bag.path}: {missing[0]} is no topic of images; {found}.")
    named = list(topics.images) or held
    if len(named) != count:
        what = "one of them with --image-topic" if count == 1 else "two of them with --image-topic LEFT,RIGHT"
        raise InputError(f"{bag.path}: {found}; name {what}." if held else f"{bag.path}: {found}.")
    return named
