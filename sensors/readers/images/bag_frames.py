"""The images of a ROS bag, one after the other: which messages of its topics they are, and when they were taken."""

import logging
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.bag_file import Bag, RawMessage, opened
from rbpf.sensors.readers.images.bag_image import COMPRESSED, IMAGE, read_message
from rbpf.sensors.readers.images.decoding import Grey, UnreadableImageError, require_shape
from rbpf.sensors.readers.images.files import decode_ahead
from rbpf.sensors.readers.images.sequence import ImageFrame, Source

_log = logging.getLogger(__name__)


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


def image_topics(bag: Bag) -> list[str]:
    """Topics that hold images."""
    return bag.of_type(IMAGE, COMPRESSED)


def read_stream(bag: Bag, topic: str) -> ImageStream:
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
                    first = read_message(bag, raw, where).shape, bag.message(raw).header.frame_id
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
        raise InputError(
            f"{where}: all {len(stamps)} images have the time {stamps_ns[0]}, their headers are not filled in."
        )
    return ImageStream(topic, stamps_ns, *first)


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
            return require_shape(where, read_message(bag, raw, where), self.shape), None
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
        return ImageFrame(
            int(self.stamps_ns[index]), images[0], images[1] if len(images) > 1 else None, problem
        )
