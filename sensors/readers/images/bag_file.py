"""ROS bags as named streams of bytes: ROS 1 (`.bag`), and ROS 2 (a folder with `metadata.yaml`, `.mcap`, `.db3`).

The library `rosbags` reads the containers. The messages that are read here have one standard definition per ROS
version, which the library brings along: definitions that a bag carries are never compiled, so that nothing of a bag
runs.
"""

import bz2
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from struct import Struct
from typing import Any, final

from rbpf.errors import InputError

SUFFIXES = frozenset({".bag", ".mcap", ".db3"})
KIND = "a ROS bag (.bag, .mcap, .db3, or a folder with metadata.yaml)"

MOST_BYTES = 1 << 30
"""No chunk of a bag is larger once it is unpacked."""

_LITTLE, _BIG = Struct("<4xII"), Struct(">4xII")
"""Where a message begins with a header: after four bytes, in both versions of ROS, seconds and nanoseconds."""


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in the bag.

    Attributes:
        type: of the message, such as sensor_msgs/msg/Image.
        data: its bytes.
        stamp_ns: time of its header.
    """

    type: str
    data: bytes
    stamp_ns: int


@final
class Bag:
    """An open bag.

    Args:
        path: file or folder, for messages.
        reader: the library's.
        types: the library's, of the bag's version of ROS.
    """

    def __init__(self, path: Path, reader: Any, types: Any) -> None:
        self.path = path
        self._reader, self._types = reader, types
        self._ros1 = path.suffix == ".bag" and path.is_file()
        # A file that was not summed up counts none at all.
        counted = any(c.msgcount for c in reader.connections)
        self.topics: dict[str, str] = {
            c.topic: c.msgtype for c in reader.connections if c.msgcount or not counted
        }
        """Types of the topics that hold messages, by their names."""

    @property
    def name(self) -> str:
        """Of the recording."""
        whole = self.path.resolve()
        return whole.stem if whole.is_file() else whole.name

    def of_type(self, *types: str) -> list[str]:
        """Topics of some types, in alphabetical order."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def messages(self, topic: str) -> Iterator[RawMessage]:
        """Messages of a topic in the order of the bag; those too short or too wrong to have a time are left out.

        Raises:
            InputError: the bag is damaged there.
        """
        chosen = [c for c in self._reader.connections if c.topic == topic]
        with _refusing(self.path), closing(self._reader.messages(connections=chosen)) as found:
            for connection, _, data in found:
                if (stamp := self._stamp(data)) is not None:
                    yield RawMessage(connection.msgtype, data, stamp)

    def message(self, raw: RawMessage) -> Any:
        """The message with its fields by name.

        Raises:
            InputError: its bytes are no message of its type.
        """
        read = self._types.deserialize_ros1 if self._ros1 else self._types.deserialize_cdr
        with _refusing(self.path):
            return read(raw.data, raw.type)

    def _stamp(self, data: bytes) -> int | None:
        layout = _LITTLE if self._ros1 or data[1:2] == b"\x01" else _BIG
        if len(data) < layout.size:
            return None
        seconds, nanoseconds = layout.unpack_from(data)
        return int(seconds) * 10**9 + int(nanoseconds) if nanoseconds < 10**9 else None


def recognises(path: Path) -> bool:
    """Whether the path ends like a bag, or is a folder with a part of one and its description."""
    if path.is_file():
        return path.suffix in SUFFIXES
    return (path / "metadata.yaml").is_file() and any(
        SUFFIXES & set(file.suffixes) for file in path.iterdir()
    )


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """A bag, closed at the end.

    Raises:
        InputError: the library is missing, or the bag is cut off, damaged, or of another version.
    """
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        problem = "a ROS bag is read with the package rosbags, which is not installed"
        raise InputError(f"{path}: {problem}: pip install 'rbpf[bags]'") from None
    ros1 = path.suffix == ".bag" and path.is_file()
    with _refusing(path):
        reader: Any = rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)
        reader.open()
    try:
        if ros1:
            _bound(path, reader.chunks)
        yield Bag(path, reader, get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST))
    finally:
        reader.close()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """What the library and its decompressors raise on damaged bytes, assertions among it, as one sentence."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join((str(error) or type(error).__name__).split())[:200].rstrip(".")
        action = "copy it again, or mend it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
        raise InputError(f"{path}: the bag cannot be read ({reason}); {action}.") from None


def _bound(path: Path, chunks: dict[int, Any]) -> None:
    """Lets packed chunks of ROS 1 unpack to no more than `MOST_BYTES`; the library itself takes what comes."""
    for place, chunk in chunks.items():
        if chunk.datasize > MOST_BYTES:
            raise InputError(f"{path}: a chunk claims to be larger than {MOST_BYTES >> 20} MiB.")
        chunks[place] = chunk._replace(decompressor=partial(_unpacked, chunk.decompressor))


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
