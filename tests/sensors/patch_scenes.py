"""Textures whose images under any affine map are known exactly, and plain NumPy twins of the patch kernels."""

import numpy as np


class Waves:
    """A sum of plane waves; a pixel gathers its own square of it, seen through a Gaussian blur.

    The affine map takes pixels to the plane: p = affine @ (px - middle) + shift. A wave of frequency f is one of
    frequency affineᵀ f in the image, where the square and the blur damp it: there is no aliasing but the image's own.
    """

    def __init__(self, seed: int, count: int = 100, blur_px: float = 0.5, contrast: float = 45.0) -> None:
        rng = np.random.default_rng(seed)
        length, turn = rng.uniform(0.02, 0.4, count), rng.uniform(0.0, 2.0 * np.pi, count)
        self.frequency = length[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, count)
        self.height = contrast * np.sqrt(2.0 / count) * (0.1 / length) ** 0.5
        self.blur_px = blur_px

    def image(
        self, shape, affine=((1.0, 0.0), (0.0, 1.0)), shift=(0.0, 0.0), noise=0.0, rng=None, mean=128.0, gain=1.0
    ):
        """(H, W) uint8."""
        middle = (np.array(shape[::-1]) - 1) / 2
        frequency = self.frequency @ np.asarray(affine)
        damping = np.sinc(frequency).prod(axis=1)
        damping *= np.exp(-2.0 * (np.pi * self.blur_px) ** 2 * (frequency**2).sum(axis=1))
        phase = self.phase + 2.0 * np.pi * (self.frequency @ np.asarray(shift) - frequency @ middle)
        # cos(a + b) is the real part of exp(ia) exp(ib): all waves at once are a matrix product.
        v, u = (2.0 * np.pi * np.arange(count)[:, None] for count in shape)
        down = gain * self.height * damping * np.exp(1j * (v * frequency[:, 1] + phase))
        grey = mean + (down @ np.exp(1j * u * frequency[:, 0]).T).real
        if noise:
            grey += noise * rng.normal(size=shape)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def window(image, px, size):
    """The (size, size) window around a whole pixel."""
    u, v, half = int(px[0]), int(px[1]), size // 2
    return image[v - half : v + half + 1, u - half : u + half + 1]


def unit(window):
    """Without mean and with unit norm, NaN where it is flat."""
    centred = np.asarray(window, float) - np.mean(window, dtype=float)
    with np.errstate(invalid="ignore"):
        return centred / np.linalg.norm(centred)


def inside_ellipse(shape, centre, cov, sigmas, most_px, size):
    """(H, W): the whole pixels that a search tries, from its definition."""
    v, u = np.indices(shape)
    offset = np.stack([u - centre[0], v - centre[1]], axis=-1)
    grown = np.asarray(cov) + 0.51 / sigmas**2 * np.eye(2)
    distance = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(grown), offset)
    half = size // 2
    fits = (u >= half) & (u < shape[1] - half) & (v >= half) & (v < shape[0] - half)
    return (distance <= sigmas**2) & (np.abs(offset) <= most_px).all(axis=-1) & fits


def score_map(image, template, tried):
    """(H, W) correlation at the pixels tried: −1 where the window is flat, −2 elsewhere."""
    scores, unit_template = np.full(image.shape, -2.0), unit(template)
    for v, u in np.argwhere(tried):
        score = (unit(window(image, (u, v), template.shape[0])) * unit_template).sum()
        scores[v, u] = -1.0 if np.isnan(score) else score
    return scores


def cubic(image, u, v):
    """Catmull-Rom interpolation at columns u and rows v, arrays of one shape; the border is repeated."""
    image = np.asarray(image, float)
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    total = np.zeros(np.shape(u))
    for j in range(-1, 3):
        for i in range(-1, 3):
            rows, columns = np.clip(top + j, 0, image.shape[0] - 1), np.clip(left + i, 0, image.shape[1] - 1)
            total += _keys(u - left - i) * _keys(v - top - j) * image[rows, columns]
    return total


def _keys(x):
    """Keys' kernel with a = −½."""
    x = np.abs(x)
    near, far = 1.0 - 2.5 * x**2 + 1.5 * x**3, 2.0 - 4.0 * x + 2.5 * x**2 - 0.5 * x**3
    return np.where(x < 1.0, near, np.where(x < 2.0, far, 0.0))


def interpolated(image, px, size):
    """The (size, size) window around a place between pixels."""
    v, u = np.indices((size, size)) - size // 2
    return cubic(image, px[0] + u, px[1] + v)
