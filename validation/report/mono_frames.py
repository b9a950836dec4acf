"""A frame of a run with what was looked for in it: ellipses, hits, misses, epipolar lines (E06, Figs. 7 and 8)."""

from typing import Any

import numpy as np

from rbpf.runs.plots import outline
from rbpf.systems.mono.video import SearchRecord
from rbpf.validation.report.annotated import (
    FOUND,
    MISSED,
    STARTED,
    Caption,
    Place,
    annotate,
    cross,
    drawn_scale,
)

RAY = (255, 190, 40)
LEGEND = (("found", FOUND), ("missed", MISSED), ("epipolar line", RAY), ("new", STARTED))


def draw_frame(
    image: np.ndarray | None, sighting: SearchRecord, caption: Caption, width: int, height: int
) -> np.ndarray:
    """The frame as it is shown (H, W, 3) uint8.

    Args:
        image: (height, width) uint8; None where it could not be read.
        sighting: what was looked for.
        caption: what is written above.
        width: of the images, px.
        height: of the images, px.
    """

    def paint(draw: Any, place: Place) -> None:
        _draw_sighting(draw, sighting, place, (width, height))

    return annotate(image, (width, height), caption, LEGEND, paint)


def _draw_sighting(draw: Any, sighting: SearchRecord, place: Place, size: tuple[int, int]) -> None:
    found, is_ray, stroke = sighting.found, sighting.is_ray, drawn_scale(size[0])
    for line in sighting.line[is_ray]:
        draw.line(place(_clipped(line, size)), fill=RAY, width=stroke)
    for ellipse, hit in zip(outline(sighting.mean, sighting.cov), found.tolist(), strict=True):
        draw.line(place(ellipse), fill=FOUND if hit else MISSED, width=stroke)
    for px in sighting.px[found]:
        cross(draw, place(px)[0], FOUND)
    for px in sighting.mean[~found]:
        cross(draw, place(px)[0], MISSED)
    for px in sighting.started_px:
        cross(draw, place(px)[0], STARTED)


def _clipped(line: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A line (2, 2) without what lies more than an image's size outside: far ends may project to anywhere."""
    start, step = line[0], line[1] - line[0]
    low, high = -np.asarray(size, dtype=float), 2.0 * np.asarray(size, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(low - start) / step, (high - start) / step]), axis=0)
    enter = max(0.0, float(np.nanmax(np.where(step == 0.0, 0.0, ends[0]))))
    leave = min(1.0, float(np.nanmin(np.where(step == 0.0, 1.0, ends[1]))))
    return start + np.array([[enter], [max(enter, leave)]]) * step
