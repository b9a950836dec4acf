"""Recognises the kind of an image sequence and opens it."""

from pathlib import Path

from rbpf.errors import InputError
from rbpf.sensors.readers.images import bag, euroc, folder, kitti, photos, seven_scenes, tum, video
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.topics import UNNAMED, Topics

_READERS = (tum, euroc, kitti, seven_scenes, photos, video, folder)


def open_images(
    path: str | Path, calibration: str | Path | None = None, topics: Topics = UNNAMED
) -> ImageSequence:
    """Open an image sequence of any known kind; the modules of the readers describe the formats.

    Args:
        path: the sequence's folder, a video, or a ROS bag.
        calibration: a `camera.yaml` to use in place of the sequence's own camera.
        topics: of a ROS bag, where they have to be named.

    Returns:
        The sequence, of which only the first image has been decoded.

    Raises:
        InputError: nothing is there, it is of no known kind, no image of it can be read, or another of its files
            is malformed; a topic is named that is not there.
    """
    path = Path(path)
    try:
        path.stat()
    except (OSError, ValueError) as error:
        reason = "no such file or folder" if isinstance(error, FileNotFoundError) else str(error)
        raise InputError(f"{path}: {reason}; expected an image sequence.") from None
    given = None if calibration is None else Path(calibration)
    if bag.recognises(path):
        return bag.read(path, given, topics)
    for reader in _READERS:
        if reader.recognises(path):
            topics.require_none(path)
            return reader.read(path, given)
    kinds = "; or ".join(reader.KIND for reader in (*_READERS, bag))
    raise InputError(f"{path}: found {_content(path)}, expected {kinds}.")


def _content(path: Path) -> str:
    if not path.is_dir():
        return f"a file that ends in {path.suffix!r}" if path.suffix else "a file"
    names = sorted(entry.name for entry in path.iterdir())
    if not names:
        return "an empty folder"
    return f"a folder with {', '.join(names[:5])}{' and more' if len(names) > 5 else ''}"
