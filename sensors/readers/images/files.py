"""Images that lie in files, decoded one after the other and a few ahead of the caller."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.readers.images.decoding import Grey, UnreadableImageError, read_grey, require_shape
from rbpf.sensors.readers.images.sequence import ImageFrame, Source

AHEAD = 4
"""Images that are decoded before they are asked for."""


@dataclass(frozen=True)
class FileImages(Source):
    """One file per image.

    Attributes:
        stamps_ns: (T,) int64 times.
        shape: height and width that every image must have.
        left: T files.
        right: T files of the second camera, None where an image has no partner; None without a second camera.
    """

    stamps_ns: np.ndarray
    shape: tuple[int, int]
    left: Sequence[Path]
    right: Sequence[Path | None] | None = None

    def frames(self, start: int) -> Generator[ImageFrame]:
        return decode_ahead(self._load, range(start, len(self.left)))

    def _load(self, index: int) -> ImageFrame:
        image, problem = self._read(self.left[index])
        right = None
        if self.right is not None:
            right, other = self._read(self.right[index])
            problem = problem or other
        return ImageFrame(int(self.stamps_ns[index]), image, right, problem)

    def _read(self, path: Path | None) -> tuple[Grey | None, str | None]:
        if path is None:
            return None, "The second camera has no image of this time."
        try:
            return require_shape(path, read_grey(path), self.shape), None
        except UnreadableImageError as error:
            return None, str(error)


def decode_ahead(load: Callable[[int], ImageFrame], indices: Iterable[int]) -> Generator[ImageFrame]:
    """Results of `load` in order, up to `AHEAD` of them computed by a thread while the caller is busy."""
    remaining = iter(indices)
    waiting: deque[Future[ImageFrame]] = deque()
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")
    try:
        waiting.extend(pool.submit(load, index) for index in islice(remaining, AHEAD))
        while waiting:
            frame = waiting.popleft().result()
            waiting.extend(pool.submit(load, index) for index in islice(remaining, 1))
            yield frame
    finally:
        pool.shutdown(cancel_futures=True)


def first_shape(paths: Sequence[Path], where: Path) -> tuple[int, int]:
    """Height and width of the first image that can be read.

    Raises:
        InputError: none can.
    """
    problems = []
    for path in paths:
        try:
            height, width = read_grey(path).shape
        except UnreadableImageError as error:
            problems.append(str(error))
        else:
            return height, width
    if not problems:
        raise InputError(f"{where}: expected images, found none.")
    raise InputError(f"{where}: none of {len(problems)} images can be read; the first is {problems[0]}")
