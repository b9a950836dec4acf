"""Recognises the kind of an image sequence and opens it."""

from pathlib import Path

from rbpf.errors import InputError
from rbpf.sensors.readers.images import euroc, folder, kitti, photos, seven_scenes, tum, video
from rbpf.sensors.readers.images.sequence import ImageSequence

_READERS = (tum, euroc, kitti, seven_scenes, photos, video, folder)


def open_images(path: str | Path, calibration: str | Path | None = None) -> ImageSequence:
    """Open an image sequence of any known kind; the modules of the readers describe the formats.

    Args:
        path: the sequence's folder, or a video.
        calibration: a `camera.yaml` to use in place of the sequence's own camera.

    Returns:
        The sequence, of which only the first image has been decoded.

    Raises:
        InputError: nothing is there, it is of no known kind, no image of it can be read, or another of its files
            is malformed.
    """
    path = Path(path)
    try:
        path.stat()
    except (OSError, ValueError) as error:
        reason = "no such file or folder" if isinstance(error, FileNotFoundError) else str(error)
        raise InputError(f"{path}: {reason}; expected an image sequence.") from None
    for reader in _READERS:
        if reader.recognises(path):
            return reader.read(path, None if calibration is None else Path(calibration))
    kinds = "; or ".join(reader.KIND for reader in _READERS)
    raise InputError(f"{path}: found {_content(path)}, expected {kinds}.")


def _content(path: Path) -> str:
    if not path.is_dir():
        return f"a file that ends in {path.suffix!r}" if path.suffix else "a file"
    names = sorted(entry.name for entry in path.iterdir())
    if not names:
        return "an empty folder"
    return f"a folder with {', '.join(names[:5])}{' and more' if len(names) > 5 else ''}"
