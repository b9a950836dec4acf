"""Images of a camera that is not known yet: those of a folder, or of a video, each with a name for messages."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.decoding import Grey, UnreadableImageError, read_grey, to_grey
from rbpf.sensors.readers.images.folder import list_images
from rbpf.sensors.readers.images.video import SUFFIXES, opened, video_header


class NamedImage(NamedTuple):
    """An image (H, W) and what it is called."""

    name: str
    image: Grey


def read_shots(path: Path, most: int) -> tuple[int, Iterator[NamedImage]]:
    """Up to `most` images, evenly spread, of a folder or a video; those that cannot be read are left out.

    Args:
        path: folder with images in it or in its `images`, or a video.
        most: images that are decoded.

    Returns:
        How many there will be at most, and the images.

    Raises:
        InputError: there is nothing of that name, or no image in it.
    """
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        count = video_header(path)[0]
        chosen = _spread(count, most)
        return len(chosen), _of_video(path, set(chosen.tolist()))
    if not path.is_dir():
        found = "is neither a folder nor a video" if path.exists() else "no such file or folder"
        raise InputError(
            f"{path}: {found}; expected a folder of images, or a video ({', '.join(sorted(SUFFIXES))})"
        )
    files = list_images(path)
    if not files:
        raise InputError(f"{path}: expected images in it or in its images/, found none")
    chosen = _spread(len(files), most)
    return len(chosen), _of_files([files[k] for k in chosen])


def _spread(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _of_files(files: list[Path]) -> Iterator[NamedImage]:
    for file in files:
        try:
            image = read_grey(file)
        except UnreadableImageError:
            continue
        yield NamedImage(file.name, image)


def _of_video(path: Path, chosen: set[int]) -> Iterator[NamedImage]:
    with opened(path) as capture:
        for index in range(max(chosen) + 1):
            if not capture.grab():
                return
            if index in chosen:
                there, image = capture.retrieve()
                if there:
                    yield NamedImage(f"image {index}", to_grey(path, image))
