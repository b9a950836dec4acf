"""Image files to grey images, in sequence and decoded a few ahead of the caller.

Colour becomes grey by OpenCV's weights (ITU-R BT.601); 16 bits become 8 over the whole range, 65535 to 255.
A photo is rotated by its EXIF orientation, as viewers and OpenCV's calibration do.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.sensors.readers.images.sequence import ImageFrame, Source
from rbpf.sensors.readers.text import read_bytes

Grey = NDArray[np.uint8]

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})


def read_grey(path: Path, shape: tuple[int, int] | None = None) -> Grey:
    """Image of a file, (H, W); `shape` is its required height and width.

    Raises InputError: the file is missing, is not a complete image of a format that OpenCV knows, or has another size.
    """
    return decode(path, np.frombuffer(read_bytes(path), dtype=np.uint8), shape)


def decode(path: Path | str, data: NDArray[np.uint8], shape: tuple[int, int] | None = None) -> Grey:
    """Image (H, W) of a file's content (B,); `path` is for messages. Raises as `read_grey`."""
    import cv2
    from PIL import Image

    if not data.size:
        raise InputError(f"{path}: the file is empty, expected an image.")
    # Checked before decoding, which allocates whatever a header claims: a damaged file may claim more pixels than the
    # camera has, or than Pillow's limit, and a PNG chunk longer than the file, which `verify` detects.
    damaged = InputError(f"{path}: the file is damaged, incomplete or not an image.")
    try:
        with Image.open(BytesIO(data.tobytes())) as header:
            width, height = header.size
            header.verify()
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(f"{path}: the image claims to be larger than any camera's.") from None
    except Exception:
        raise damaged from None
    if shape is not None and width * height != shape[0] * shape[1]:  # EXIF may swap the two
        raise _other_size(path, (height, width), shape)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise InputError(f"{path}: the image cannot be decoded ({error.err}).") from None
    if image is None:
        raise damaged
    return require_shape(path, _to_8_bits(path, image), shape)


def to_grey(path: Path | str, image: np.ndarray) -> Grey:
    """Grey image (H, W) of a decoded video image (H, W), (H, W, 1) or (H, W, 3) in the order blue, green, red.

    Raises InputError: it has another depth than 8 or 16 bits.
    """
    import cv2

    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return _to_8_bits(path, image)


def require_shape(path: Path | str, image: Grey, shape: tuple[int, int] | None) -> Grey:
    """The image. Raises InputError: `shape` is given and the image has another one."""
    if shape is not None and image.shape != shape:
        raise _other_size(path, image.shape[:2], shape)
    return image


def _other_size(path: Path | str, found: tuple[int, int], shape: tuple[int, int]) -> InputError:
    expected = f"expected {shape[1]}x{shape[0]} px as in the camera file"
    return InputError(f"{path}: {expected}, found {found[1]}x{found[0]} px.")


def _to_8_bits(path: Path | str, image: np.ndarray) -> Grey:
    if image.dtype == np.uint16:
        return np.rint(image * (255.0 / 65535.0)).astype(np.uint8)
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 or 16 bits per channel, found {image.dtype}.")
    return image


AHEAD = 4  #: Number of images decoded in advance.


@dataclass(frozen=True)
class FileImages(Source):
    """One file per image of a height and width, at times (T,); also of the right camera if there are two."""

    stamps_ns: np.ndarray
    shape: tuple[int, int]
    left: Sequence[Path]
    right: Sequence[Path] | None = None

    def frames(self, start: int) -> Generator[ImageFrame]:
        cameras = [self.left] if self.right is None else [self.left, self.right]

        def load(index: int) -> ImageFrame:
            return frame_of(self.stamps_ns[index], *(partial(read_grey, files[index], self.shape) for files in cameras))

        return decode_ahead(load, range(start, len(self.left)))


def frame_of(stamp_ns: int, *reads: Callable[[], Grey]) -> ImageFrame:
    """A frame from one or two readers; an InputError becomes the frame's `problem`, without that image."""
    images, problem = list[Grey | None](), None
    for read in reads:
        try:
            images.append(read())
        except InputError as error:
            images.append(None)
            problem = problem or str(error)
    image, right = (*images, None)[:2]
    return ImageFrame(int(stamp_ns), image, right, problem)


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
    """Height and width of the first image that can be read."""
    problems = []
    for path in paths:
        try:
            height, width = read_grey(path).shape
            return height, width
        except InputError as error:
            problems.append(str(error))
    if not problems:
        raise InputError(f"{where}: expected images, found none.")
    raise InputError(f"{where}: none of {len(problems)} images can be read; the first is {problems[0]}")
