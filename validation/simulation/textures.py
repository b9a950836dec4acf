"""Random grey textures with the statistics of natural images: 1/f clouds, edges, blobs, marks.

Every function takes a shape (rows, columns) of texels and a generator, and returns uint8.
"""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

Shape = tuple[int, int]
Paint = Callable[[Shape, Generator], np.ndarray]  #: Draws a texture of a shape.
GLYPH = 7, 5  #: Cells of a mark, rows and columns.
FINE = 4  #: Fractional bits of drawn coordinates.


def clouds(shape: Shape, rng: Generator, exponent: float = 1.0) -> np.ndarray:
    """Noise (H, W) float32 of mean 0 and variance 1 whose amplitude decreases as f^-exponent (D. Field 1987)."""
    from scipy import fft

    radius = np.hypot(fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])).astype(np.float32)
    radius[0, 0] = np.inf
    spectrum = fft.rfft2(rng.standard_normal(shape, dtype=np.float32)) * radius**-exponent
    noise = fft.irfft2(spectrum, shape)
    return np.asarray(noise / noise.std())


def faded(texture: np.ndarray, contrast: float) -> np.ndarray:
    """Scales the contrast of a texture about its mean; 1 leaves it unchanged."""
    grey = np.asarray(texture, dtype=np.float32)
    return grey_levels(grey.mean() + contrast * (grey - grey.mean()))


def grey_levels(texture: np.ndarray) -> np.ndarray:
    """Rounded and clipped to uint8."""
    return np.clip(np.rint(texture), 0, 255).astype(np.uint8)


def plaster(shape: Shape, rng: Generator) -> np.ndarray:
    """A painted wall with stains, cracks and nail holes."""
    wall = grey_levels(rng.uniform(150, 190) + 8.0 * clouds(shape, rng, 1.2))
    _scatter(wall, rng, per_texel=4e-5, size=(2.0, 12.0), contrast=40.0)
    return wall


def wallpaper(shape: Shape, rng: Generator) -> np.ndarray:
    """Ornaments on a grid, no two alike, on a mottled ground."""
    paper = plaster(shape, rng)
    step = 90
    for y in range(step // 2, shape[0], step):
        for x in range(step // 2 + step // 2 * (y // step % 2), shape[1], step):
            place = np.array([x, y]) + rng.normal(0.0, 3.0, 2)
            _polygon(paper, place, rng.uniform(8.0, 18.0), rng.uniform(70, 230), rng)
    return paper


def wood(shape: Shape, rng: Generator) -> np.ndarray:
    """Grain along the rows, knots and stains."""
    import cv2

    grain = clouds((shape[0], max(2, shape[1] // 24)), rng, 0.7)
    grain = cv2.resize(grain, shape[::-1], interpolation=cv2.INTER_CUBIC)
    top = grey_levels(145.0 + 8.0 * grain + 12.0 * clouds(shape, rng))
    _scatter(top, rng, per_texel=1.5e-4, size=(3.0, 20.0), contrast=60.0)
    return top


def carpet(shape: Shape, rng: Generator) -> np.ndarray:
    """A coarse weave with patches."""
    floor = grey_levels(95.0 + 16.0 * clouds(shape, rng, 0.6) + 10.0 * clouds(shape, rng, 1.3))
    _scatter(floor, rng, per_texel=1.5e-4, size=(5.0, 30.0), contrast=50.0)
    return floor


def picture(shape: Shape, rng: Generator) -> np.ndarray:
    """A print in a frame: clouds, overlapping shapes, a line of marks."""
    image = grey_levels(rng.uniform(80, 170) + 35.0 * clouds(shape, rng, 1.2))
    extent = float(np.hypot(*shape))
    _scatter(image, rng, per_texel=24.0 / image.size, size=(0.03 * extent, 0.16 * extent), contrast=95.0)
    _scatter(image, rng, per_texel=40.0 / image.size, size=(0.01 * extent, 0.03 * extent), contrast=95.0)
    high = max(GLYPH[0], round(0.08 * extent))
    _write(image, rng, top=int(rng.uniform(0.1, 0.7) * shape[0]), high=high, ink=rng.uniform(10, 60))
    level, thick = round(rng.uniform(15, 240)), max(1, round(0.015 * extent))
    for border in (image[:thick], image[-thick:], image[:, :thick], image[:, -thick:]):
        border[...] = level
    return image


def page(shape: Shape, rng: Generator) -> np.ndarray:
    """A printed sheet: a headline, lines of text, a figure."""
    sheet = grey_levels(215.0 + 4.0 * clouds(shape, rng))
    high = max(GLYPH[0], shape[0] // 12)
    _write(sheet, rng, top=high, high=high, ink=25.0)
    row = 3 * high
    while row < shape[0] - high:
        small = max(3, round(high * rng.uniform(0.25, 0.6)))
        if rng.random() < 0.15 and row + 4 * high < shape[0]:
            inset = sheet[row : row + 3 * high, shape[1] // 6 : shape[1] * 5 // 6]
            inset[...] = picture(inset.shape, rng)
            row += 3 * high + small
        else:
            _write(sheet, rng, top=row, high=small, ink=rng.uniform(20, 90))
            row += round(1.8 * small)
    return sheet


def edges_of_pages(shape: Shape, rng: Generator) -> np.ndarray:
    """The cut side of a book: fine lines along the longer side, and thumb marks."""
    along_rows = shape[1] >= shape[0]
    lines = rng.normal(0.0, 16.0, (shape[0], 1) if along_rows else (1, shape[1]))
    side = grey_levels(195.0 + lines + 6.0 * clouds(shape, rng))
    _scatter(side, rng, per_texel=6.0 / side.size, size=(2.0, 5.0), contrast=60.0)
    return side


def carton(shape: Shape, rng: Generator) -> np.ndarray:
    """A printed box: panels, marks and shapes."""
    side = grey_levels(rng.uniform(60, 200) + 10.0 * clouds(shape, rng))
    extent = float(np.hypot(*shape))
    _scatter(side, rng, per_texel=14.0 / side.size, size=(0.04 * extent, 0.15 * extent), contrast=90.0)
    for top in np.linspace(0.08, 0.75, 3) * shape[0]:
        high = max(GLYPH[0], round(rng.uniform(0.05, 0.14) * extent))
        _write(side, rng, top=int(top), high=high, ink=rng.choice([20.0, 235.0]))
    return side


def chessboard(squares: Shape, texels: int, margin: int) -> np.ndarray:
    """Squares (rows, columns) of `texels` a side, the first one black, in a white margin."""
    rows, columns = np.indices(squares)
    cells = np.where((rows + columns) % 2 == 0, 20, 235).astype(np.uint8)
    return np.pad(cells.repeat(texels, axis=0).repeat(texels, axis=1), margin, constant_values=235)


def _scatter(image: np.ndarray, rng: Generator, per_texel: float, size: tuple[float, float], contrast: float) -> None:
    """Draws random polygons and ellipses, mostly small, brighter or darker than their background by up to `contrast`."""
    for _ in range(rng.poisson(per_texel * image.size)):
        place = rng.uniform(0.0, 1.0, 2) * image.shape[::-1]
        radius = 1.0 / rng.uniform(1.0 / size[1], 1.0 / size[0])
        column, row = place.astype(int)
        level = float(image[row, column]) + (-1.0, 1.0)[rng.integers(2)] * contrast * rng.uniform(0.4, 1.0)
        draw = _polygon if rng.random() < 0.75 else _disc
        draw(image, place, radius, min(max(level, 0.0), 255.0), rng)


def _polygon(image: np.ndarray, place: np.ndarray, radius: float, level: float, rng: Generator) -> None:
    """Draws a polygon of three to six corners around a place (column, row)."""
    import cv2

    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, rng.integers(3, 7)))
    reach = radius * rng.uniform(0.5, 1.0, (angle.size, 1))
    corners = place + reach * np.array([np.cos(angle), np.sin(angle)]).T
    fixed = np.round(corners * 2**FINE).astype(np.int32)
    cv2.fillPoly(image, [fixed], level, cv2.LINE_AA, FINE)


def _disc(image: np.ndarray, place: np.ndarray, radius: float, level: float, rng: Generator) -> None:
    """Draws an ellipse centred at a place (column, row)."""
    import cv2

    centre = [round(float(x) * 2**FINE) for x in place]
    axes = [max(1, round(radius * fraction * 2**FINE)) for fraction in rng.uniform(0.4, 1.0, 2)]
    turn = float(rng.uniform(0.0, 180.0))
    cv2.ellipse(image, centre, axes, turn, 0.0, 360.0, level, -1, cv2.LINE_AA, FINE)


def _write(image: np.ndarray, rng: Generator, top: int, high: int, ink: float) -> None:
    """Draws a line of words: marks `high` texels high, ragged at the right."""
    import cv2

    wide = max(2, high * GLYPH[1] // GLYPH[0])
    pitch = wide + max(1, wide // 4)
    column, end = pitch, int(image.shape[1] * rng.uniform(0.6, 0.95)) - wide
    if top + high > image.shape[0]:
        return
    while column < end:
        for _ in range(int(rng.integers(2, 9))):
            if column >= end:
                return
            mark = (rng.random(GLYPH) < 0.5).astype(np.float32)
            cover = cv2.resize(mark, (wide, high), interpolation=cv2.INTER_AREA)
            place = image[top : top + high, column : column + wide]
            place[...] = grey_levels(place + cover * (ink - place))
            column += pitch
        column += pitch
