"""Images of a ROS bag's messages: sensor_msgs Image and CompressedImage to grey values.

Encodings are those of `sensor_msgs/image_encodings`: grey and colour of 8 bits, grey of 16, and the Bayer patterns.
What a message claims is compared with its bytes before anything is made of it.
"""

from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.bag_file import Bag, RawMessage
from rbpf.sensors.readers.images.decoding import Grey, UnreadableImageError, decode, to_grey

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

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
}
"""Encoding to channels, type of their values, and OpenCV's way to grey, None where it is grey."""


def read_message(bag: Bag, raw: RawMessage, where: str) -> Grey:
    """Image (H, W) of a message.

    Args:
        bag: from which it is.
        raw: the message.
        where: bag and topic, for messages.

    Raises:
        UnreadableImageError: it is damaged, or of an encoding that is not listed above.
    """
    try:
        message = bag.message(raw)
    except InputError:
        raise UnreadableImageError(f"{where}: a message is damaged.") from None
    if raw.type == COMPRESSED:
        return decode(where, np.asarray(message.data, np.uint8))
    return to_grey(where, _plane(where, message))


def _plane(where: str, message: Any) -> np.ndarray:
    """What the bytes say, (H, W) grey of 8 or 16 bits."""
    import cv2

    if message.encoding not in _LAYOUTS:
        known = ", ".join(_LAYOUTS)
        raise UnreadableImageError(
            f"{where}: the encoding {message.encoding[:40]!r} is none of {known}; convert it."
        )
    channels, kind, conversion = _LAYOUTS[message.encoding]
    width = message.width * channels * np.dtype(kind).itemsize
    if not (message.height > 0 and 0 < width <= message.step):
        raise UnreadableImageError(
            f"{where}: {message.width}x{message.height} px in rows of {message.step} bytes."
        )
    if message.height * message.step != len(message.data):
        expected = f"expected {message.height} rows of {message.step} bytes"
        raise UnreadableImageError(f"{where}: {expected}, found {len(message.data)} bytes.")
    rows = np.ascontiguousarray(message.data.reshape(message.height, message.step)[:, :width])
    pixels = rows.view(np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")).astype(kind)
    if conversion is None:
        return pixels
    if channels > 1:
        pixels = pixels.reshape(message.height, message.width, channels)
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)))
