"""Annotated frames: the image, a line of text above it, a legend, and whatever a system draws into it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Colour = tuple[int, int, int]
Place = Callable[[np.ndarray], list[tuple[float, float]]]
"""Pixels (…, 2) of the image to points of the picture."""

FOUND, MISSED, STARTED, TEXT = (60, 220, 60), (240, 60, 50), (90, 170, 255), (255, 255, 255)

_SMALL_PX = 800
"""Images that are narrower are drawn at twice their size: an ellipse of three pixels shows nothing."""

_ARM, _BAND = 4, 24
_LETTER_FRACTION, _SMALLEST, _LARGEST = 1.0 / 62.0, 11.0, 17.0
"""Height of letters as a fraction of the drawn width, and its bounds, px."""


@dataclass(frozen=True)
class Caption:
    """What is written above a frame.

    Attributes:
        text: figures of the frame.
        alarm: a warning, empty where all is well.
    """

    text: str
    alarm: str


def drawn_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of a drawn frame, even numbers, as video needs them."""
    scale = drawn_scale(width)
    return scale * width + (scale * width) % 2, scale * height + _BAND + (scale * height + _BAND) % 2


def drawn_scale(width: int) -> int:
    """How many times an image of this width is enlarged."""
    return 2 if width < _SMALL_PX else 1


def annotate(
    image: np.ndarray | None,
    size: tuple[int, int],
    caption: Caption,
    legend: Sequence[tuple[str, Colour]],
    paint: Callable[[Any, Place], None],
) -> np.ndarray:
    """The frame as it is shown (H, W, 3) uint8.

    Args:
        image: (height, width) uint8; None where it could not be read.
        size: width and height of the images, px.
        caption: what is written above.
        legend: names and colours.
        paint: called with PIL's drawing of the picture, and with what tells where a pixel lies in it.
    """
    from PIL import Image, ImageDraw, ImageFont

    scale, drawn = drawn_scale(size[0]), drawn_size(*size)
    picture = Image.new("RGB", drawn)
    if image is not None:
        shown = Image.fromarray(image).resize((scale * size[0], scale * size[1]), Image.Resampling.BILINEAR)
        picture.paste(shown.convert("RGB"), (0, _BAND))
    draw = ImageDraw.Draw(picture)
    draw.font = ImageFont.load_default(min(max(_LETTER_FRACTION * drawn[0], _SMALLEST), _LARGEST))

    def place(px: np.ndarray) -> list[tuple[float, float]]:
        shifted = scale * (np.atleast_2d(px) + 0.5) - 0.5 + [0.0, _BAND]
        return [(float(x), float(y)) for x, y in shifted]

    paint(draw, place)
    draw.rectangle((0, 0, drawn[0], _BAND), fill=(0, 0, 0))
    draw.text((4, 3), caption.text, fill=TEXT)
    end = draw.textlength(caption.text) + 16
    draw.text((end, 3), caption.alarm, fill=MISSED)
    _draw_legend(draw, drawn[0], legend)
    return np.asarray(picture)


def cross(draw: Any, at: tuple[float, float], colour: Colour) -> None:
    """A small upright cross at a point of the picture."""
    x, y = at
    draw.line((x - _ARM, y, x + _ARM, y), fill=colour)
    draw.line((x, y - _ARM, x, y + _ARM), fill=colour)


def _draw_legend(draw: Any, width: int, legend: Sequence[tuple[str, Colour]]) -> None:
    at = width - 6.0
    for name, colour in reversed(legend):
        at -= draw.textlength(name)
        draw.text((at, 3), name, fill=colour)
        at -= 12.0
