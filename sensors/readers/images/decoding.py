"""Bytes of an image file to grey values.

Colour becomes grey by OpenCV's weights (ITU-R BT.601); 16 bits become 8 over the whole range, 65535 to 255.
A photo is turned as its EXIF orientation says, as viewers and OpenCV's calibration do.
"""

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})


class UnreadableImageError(Exception):
    """An image that is missing or damaged; its text is the sentence for `ImageFrame.problem`."""


def read_grey(path: Path) -> Grey:
    """Image of a file, (H, W).

    Raises:
        UnreadableImageError: the file is missing, or is no complete image of a format that OpenCV knows.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except FileNotFoundError:
        raise UnreadableImageError(f"{path}: no such image.") from None
    except (OSError, ValueError) as error:
        raise UnreadableImageError(f"{path}: the image cannot be read ({error}).") from None
    return decode(path, data)


def decode(path: Path | str, data: NDArray[np.uint8]) -> Grey:
    """Image (H, W) of the content (B,) of a file.

    Args:
        path: where it is from, for messages.
        data: the bytes.

    Raises:
        UnreadableImageError: they are no complete image of a format that OpenCV knows.
    """
    import cv2

    if not data.size:
        raise UnreadableImageError(f"{path}: the file is empty, expected an image.")
    _require_size(path, data)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise UnreadableImageError(f"{path}: the image cannot be decoded ({error.err}).") from None
    if image is None:
        raise UnreadableImageError(f"{path}: the file is damaged, incomplete or no image.")
    return _to_8_bits(path, image)


def to_grey(path: Path | str, image: np.ndarray) -> Grey:
    """Grey image (H, W) of a decoded video image (H, W), (H, W, 1) or (H, W, 3) in the order blue, green, red.

    Raises:
        UnreadableImageError: it has another depth than 8 or 16 bits.
    """
    import cv2

    if image.ndim == 3:
        image = image[:, :, 0] if image.shape[2] == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return _to_8_bits(path, image)


def require_shape(path: Path | str, image: Grey, shape: tuple[int, int]) -> Grey:
    """The image, if it has this height and width.

    Raises:
        UnreadableImageError: it has another size.
    """
    if image.shape != shape:
        found = f"found {image.shape[1]}x{image.shape[0]} px"
        raise UnreadableImageError(
            f"{path}: expected {shape[1]}x{shape[0]} px as in the camera file, {found}."
        )
    return image


def _require_size(path: Path | str, data: NDArray[np.uint8]) -> None:
    """Refuses, before anything is decoded, an image whose header claims more pixels than Pillow takes for sane."""
    from PIL import Image

    try:
        Image.open(BytesIO(data.tobytes())).close()
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise UnreadableImageError(f"{path}: the image claims to be larger than any camera's.") from None
    except Exception:
        pass


def _to_8_bits(path: Path | str, image: np.ndarray) -> Grey:
    if image.dtype == np.uint16:
        return np.rint(image * (255.0 / 65535.0)).astype(np.uint8)
    if image.dtype != np.uint8:
        raise UnreadableImageError(f"{path}: expected 8 or 16 bits per channel, found {image.dtype}.")
    return image
