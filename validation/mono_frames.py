"""A frame of a run with what was looked for in it: ellipses, hits, misses, epipolar lines (E06, Figs. 7 and 8)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rbpf.systems.mono.sightings import Sighting
from rbpf.validation.figures import outline

FOUND, MISSED, RAY, STARTED, TEXT = (
    (60, 220, 60),
    (240, 60, 50),
    (255, 190, 40),
    (90, 170, 255),
    (255, 255, 255),
)
LEGEND = (("found", FOUND), ("missed", MISSED), ("epipolar line", RAY), ("new", STARTED))

_SMALL_PX = 800
"""Images that are narrower are drawn at twice their size: an ellipse of three pixels shows nothing."""

_ARM, _BAND = 4, 24
_LETTER_SHARE, _SMALLEST, _LARGEST = 1.0 / 62.0, 11.0, 17.0
"""Height of letters as a share of the drawn width, and its bounds, px."""


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
    scale = _scale(width)
    return scale * width + (scale * width) % 2, scale * height + _BAND + (scale * height + _BAND) % 2


def draw_frame(
    image: np.ndarray | None, sighting: Sighting, caption: Caption, width: int, height: int
) -> np.ndarray:
    """The frame as it is shown (H, W, 3) uint8.

    Args:
        image: (height, width) uint8; None where it could not be read.
        sighting: what was looked for.
        caption: what is written above.
        width: of the images, px.
        height: of the images, px.
    """
    from PIL import Image, ImageDraw, ImageFont

    scale, size = _scale(width), drawn_size(width, height)
    picture = Image.new("RGB", size)
    if image is not None:
        shown = Image.fromarray(image).resize((scale * width, scale * height), Image.Resampling.BILINEAR)
        picture.paste(shown.convert("RGB"), (0, _BAND))
    draw = ImageDraw.Draw(picture)
    draw.font = ImageFont.load_default(min(max(_LETTER_SHARE * size[0], _SMALLEST), _LARGEST))

    def place(px: np.ndarray) -> list[tuple[float, float]]:
        shifted = scale * (np.atleast_2d(px) + 0.5) - 0.5 + [0.0, _BAND]
        return [(float(x), float(y)) for x, y in shifted]

    _draw_sighting(draw, sighting, place, (width, height), scale)
    draw.rectangle((0, 0, size[0], _BAND), fill=(0, 0, 0))
    draw.text((4, 3), caption.text, fill=TEXT)
    end = draw.textlength(caption.text) + 16
    draw.text((end, 3), caption.alarm, fill=MISSED)
    _draw_legend(draw, size[0])
    return np.asarray(picture)


def _scale(width: int) -> int:
    return 2 if width < _SMALL_PX else 1


def _draw_sighting(draw: Any, sighting: Sighting, place: Any, size: tuple[int, int], stroke: int) -> None:
    found, is_ray = sighting.found, sighting.is_ray
    for line in sighting.line[is_ray]:
        draw.line(place(_clipped(line, size)), fill=RAY, width=stroke)
    for ellipse, hit in zip(outline(sighting.mean, sighting.cov), found.tolist(), strict=True):
        draw.line(place(ellipse), fill=FOUND if hit else MISSED, width=stroke)
    for px in sighting.px[found]:
        _cross(draw, place(px)[0], FOUND)
    for px in sighting.mean[~found]:
        _cross(draw, place(px)[0], MISSED)
    for px in sighting.started:
        _cross(draw, place(px)[0], STARTED)


def _cross(draw: Any, at: tuple[float, float], colour: tuple[int, int, int]) -> None:
    x, y = at
    draw.line((x - _ARM, y, x + _ARM, y), fill=colour)
    draw.line((x, y - _ARM, x, y + _ARM), fill=colour)


def _draw_legend(draw: Any, width: int) -> None:
    at = width - 6.0
    for name, colour in reversed(LEGEND):
        at -= draw.textlength(name)
        draw.text((at, 3), name, fill=colour)
        at -= 12.0


def _clipped(line: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A line (2, 2) without what lies more than an image's size outside: far ends may project to anywhere."""
    start, step = line[0], line[1] - line[0]
    low, high = -np.asarray(size, dtype=float), 2.0 * np.asarray(size, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(low - start) / step, (high - start) / step]), axis=0)
    enter = max(0.0, float(np.nanmax(np.where(step == 0.0, 0.0, ends[0]))))
    leave = min(1.0, float(np.nanmin(np.where(step == 0.0, 1.0, ends[1]))))
    return start + np.array([[enter], [max(enter, leave)]]) * step
