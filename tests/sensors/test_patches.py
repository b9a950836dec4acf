"""The search of patches against plain NumPy, and what it does at its limits, on textures whose images are known exactly."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.features import CornerDetector
from rbpf.sensors.patches.kernels import OUTSIDE, footprint, interval, normalised, score_ellipse
from rbpf.sensors.patches.search import cut, search, warp


class Waves:
    """A sum of plane waves; a pixel gathers its own square of it, seen through a Gaussian blur.
    The affine map takes pixels to the plane: p = affine @ (px - middle) + shift. A wave of frequency f is one of
    frequency affineᵀ f in the image, where the square and the blur damp it: there is no aliasing but the image's own."""

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


SHAPE = (90, 110)
ROUND = 9.0 * np.eye(2)


@pytest.fixture(scope="module")
def image():
    return Waves(1).image(SHAPE)


def one(image, template, centre, cov=ROUND, **options):
    """The match of a single template."""
    matches = search(image, np.asarray(template)[None], np.array([centre], float), np.array([cov], float), **options)
    return matches.px[0], matches.score[0], matches.second[0], matches.cov[0]


def kernel_map(image, template, centre, cov, sigmas, most_px):
    """(H, W) scores of the kernel."""
    size, scores = template.shape[0], np.full(image.shape, float(OUTSIDE))
    centre, cov = np.array(centre, float), np.array(cov, float)
    columns, rows = interval(centre, cov, sigmas, most_px, image.shape, size)
    part = np.full((max(rows[1] - rows[0] + 1, 0), max(columns[1] - columns[0] + 1, 0)), OUTSIDE)
    if part.size:
        units = normalised(template.astype(np.float32), 0.0)
        score_ellipse(image, units, size, centre, cov, sigmas, columns, rows, part)
        scores[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1] = part
    return scores


@pytest.mark.parametrize("size", [3, 11, 13])
@pytest.mark.parametrize(
    ("centre", "cov", "sigmas", "most_px"),
    [
        ((50.3, 40.8), [[9.0, 4.0], [4.0, 5.0]], 3.0, 40.0),
        ((50.5, 40.5), [[0.0, 0.0], [0.0, 0.0]], 3.0, 40.0),
        ((50.5, 40.5), [[16.0, 0.0], [0.0, 0.0]], 2.0, 40.0),
        ((50.2, 40.1), [[25.0, 20.0], [20.0, 16.0]], 1.5, 40.0),
        ((2.0, 3.0), [[9.0, -4.0], [-4.0, 5.0]], 3.0, 40.0),
        ((-4.0, 95.0), [[25.0, 0.0], [0.0, 25.0]], 3.0, 40.0),
        ((55.0, 45.0), [[400.0, 0.0], [0.0, 400.0]], 3.0, 7.5),
        ((55.0, 45.0), [[1e8, 0.0], [0.0, 1e8]], 3.0, np.inf),
    ],
)
def test_scores_of_an_ellipse_equal_numpys(image, size, centre, cov, sigmas, most_px):
    template = window(image, (54, 47), size)
    tried = inside_ellipse(image.shape, centre, cov, sigmas, most_px, size)
    assert tried.any() or centre[0] < 5
    expected = score_map(image, template, tried)
    np.testing.assert_allclose(kernel_map(image, template, centre, cov, sigmas, most_px), expected, atol=1e-5)


def test_scores_of_patches_without_contrast_equal_numpys():
    image = np.random.default_rng(0).choice(np.array([254, 255], np.uint8), SHAPE)
    image[30:60, 30:60] = 255
    template, everywhere = window(image, (70, 50), 11), ((55.0, 45.0), 1e6 * np.eye(2), 3.0, np.inf)
    expected = score_map(image, template, inside_ellipse(SHAPE, *everywhere, 11))
    assert (expected == -1.0).sum() == 20 * 20
    np.testing.assert_allclose(kernel_map(image, template, *everywhere), expected, atol=1e-5)


def test_covariance_is_the_residual_over_the_slopes(image):
    noisy = Waves(1).image(SHAPE, noise=5.0, rng=np.random.default_rng(2))
    px, score, _, cov = one(image, window(noisy, (60, 45), 11), (60.0, 45.0))
    around = interpolated(image, px, 13)
    w = unit(around[1:-1, 1:-1])
    norm = np.linalg.norm(around[1:-1, 1:-1] - around[1:-1, 1:-1].mean())
    slopes = [(around[1:-1, 2:] - around[1:-1, :-2]) / 2, (around[2:, 1:-1] - around[:-2, 1:-1]) / 2]
    jac = np.stack([(s - s.mean() - ((s - s.mean()) * w).sum() * w).ravel() / norm for s in slopes], axis=1)
    residual = 1.0 - score**2
    expected = residual / (121 - 4) * np.linalg.inv(jac.T @ jac - 0.25 * residual * np.eye(2)) + 0.02**2 * np.eye(2)
    np.testing.assert_allclose(cov, expected, rtol=0.02, atol=1e-6)


def test_second_is_the_next_peak():
    image = Waves(3).image(SHAPE)
    image[60:81, 60:81] = image[20:41, 20:41]
    template = window(image, (30, 30), 11)
    px, score, second, _ = one(image, template, (50.0, 50.0), 400.0 * np.eye(2))
    np.testing.assert_allclose(px, (30, 30), atol=1e-3)
    assert score == pytest.approx(1.0, abs=1e-6) and second == pytest.approx(1.0, abs=1e-6)
    assert one(image, template, (30.0, 30.0), ROUND)[2] < 0.9  # alone


@pytest.mark.parametrize(
    ("template", "centre", "cov"),
    [
        (np.full((11, 11), 80.0), (50.0, 40.0), ROUND),
        (np.full((11, 11), np.nan), (50.0, 40.0), ROUND),
        (None, (np.nan, 40.0), ROUND),
        (None, (1e300, 40.0), ROUND),
        (None, (50.0, -30.0), ROUND),
        (None, (50.0, 40.0), [[1.0, np.nan], [np.nan, 1.0]]),
        (None, (50.0, 40.0), [[-1.0, 0.0], [0.0, 1.0]]),
        (None, (50.0, 40.0), [[4.0, 9.0], [9.0, 4.0]]),
    ],
)
def test_nothing_is_found_without_contrast_or_a_place_to_look(image, template, centre, cov):
    px, score, second, spread = one(image, window(image, (50, 40), 11) if template is None else template, centre, cov)
    assert np.isnan(px).all() and np.isnan(spread).all() and score == -1.0 and second == -1.0


def test_the_least_contrast_is_that_which_is_asked_for(image):
    faint = 100.0 + 2.0 * unit(window(image, (50, 40), 11)) * 11.0
    assert one(image, faint, (50.0, 40.0), least_std=2.1)[1] == -1.0
    assert one(image, faint, (50.0, 40.0), least_std=1.9)[1] > 0.99


@pytest.mark.parametrize("px", [(5, 5), (104, 5), (5, 84), (104, 84)])
def test_the_outermost_place_is_found(px):
    waves, shift = Waves(6), np.array([0.3, -0.2])
    template = interpolated(waves.image((150, 170)), np.array(px) + 30 + shift, 11)
    found, score, _, _ = one(waves.image((150, 170))[30:120, 30:140], template, px)
    np.testing.assert_allclose(found, px + shift, atol=0.15)
    assert score > 0.97


def test_a_place_on_a_slope_has_no_covariance():
    """The best score lies at the edge of the ellipse and rises beyond it."""
    image = Waves(1, blur_px=2.0).image(SHAPE)
    px, score, _, cov = one(image, window(image, (50, 40), 11), (47.0, 40.0), np.zeros((2, 2)))
    assert 0.0 < score < 0.95 and np.isnan(cov).all()
    assert np.array_equal(px, np.rint(px)) and abs(px[0] - 47.0) <= 1.0


TURN = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
MAPS = {
    "same": np.eye(2),
    "turned": TURN,
    "upside down": -np.eye(2),
    "larger": 0.6 * np.eye(2),
    "smaller": 1.5 * np.eye(2),
    "half": 2.0 * np.eye(2),
    "third": 2.6 * np.eye(2),
    "squeezed": np.diag([2.2, 1.0]),
    "sheared": np.array([[1.0, 0.6], [0.0, 1.2]]),
    "turned and smaller": 1.6 * TURN,
}


@pytest.fixture(scope="module")
def picture():
    return Waves(1).image((80, 100))


@pytest.mark.parametrize("px", [(40.0, 30.0), (40.3, 30.8)])
def test_cut_is_numpys_and_does_not_reach_beyond(picture, px):
    v, u = np.indices((31, 31)) - 15
    expected = np.clip(np.floor(cubic(picture, px[0] + u, px[1] + v) + 0.5), 0, 255)
    assert np.array_equal(cut(picture, np.array(px)), expected)
    for beyond in ((14.9, 30.0), (84.1, 30.0), (40.0, 14.0), (40.0, 64.5), (np.nan, 30.0)):
        assert cut(picture, np.array(beyond)) is None


@pytest.mark.parametrize("name", MAPS)
def test_warp_equals_numpys(picture, name):
    source, affine = window(picture, (45, 40), 61), MAPS[name]
    v, u = np.indices((11, 11)) - 5
    places = 30 + np.stack([u, v], axis=-1) @ affine.T
    samples = footprint(*affine.ravel(), 61)
    expected = np.mean([cubic(source, places[..., 0] + x, places[..., 1] + y) for x, y in samples], axis=0)
    found = warp(source[None], affine[None])[0]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("name", MAPS)
def test_samples_make_up_for_the_larger_pixel(name):
    """Their covariance is that of the new pixel's square in the source less that of the source's own pixel."""
    samples = footprint(*MAPS[name].ravel(), 61)
    values, vectors = np.linalg.eigh(MAPS[name] @ MAPS[name].T - np.eye(2))
    expected = vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T / 12.0
    np.testing.assert_allclose(samples.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(samples.T @ samples / len(samples), expected, atol=1e-6)
    assert np.diff(np.unique(samples.round(9), axis=0), axis=0).max(initial=0.0) < 2.0 * np.abs(samples).max() + 1.0


@pytest.mark.parametrize(
    "affine",
    [3.01 * np.eye(2), np.diag([3.5, 1.0]), np.full((2, 2), np.nan), np.diag([np.inf, 1.0]), 1e200 * np.eye(2)],
)
def test_a_view_of_more_than_the_source_has_no_template(picture, affine):
    templates = warp(np.repeat(window(picture, (45, 40), 31)[None], 2, axis=0), np.stack([affine, np.eye(2)]))
    assert np.isnan(templates[0]).all() and np.isfinite(templates[1]).all()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"image": np.zeros(SHAPE)}, "must be grey"),
        ({"templates": np.zeros((1, 10, 10))}, "odd size"),
        ({"centres": np.zeros((2, 2))}, "one for each template"),
        ({"most_px": np.nan}, "most_px not negative"),
    ],
)
def test_wrong_arguments(image, change, sentence):
    parts = {"templates": np.zeros((1, 11, 11)), "centres": np.zeros((1, 2)), "covs": np.zeros((1, 2, 2))}
    with pytest.raises(InputError, match=sentence):
        search(**{"image": image} | parts | change)
    with pytest.raises(InputError, match="uint8"):
        warp(np.zeros((1, 31, 31)), np.eye(2)[None])


SPREAD_PX = 2.0
WRONG_PX = 1.5
"""A place further from the truth is a wrong match."""


def errors(noise, seed):
    """Errors (k, 2) and covariances of accepted matches between two views that are shifted."""
    rng, shift = (np.random.default_rng(seed), np.array([0.31, -0.42]) + np.random.default_rng(seed).uniform(-1, 1, 2))
    waves = Waves(seed, blur_px=0.7)
    first = waves.image((240, 260), noise=noise, rng=rng)
    then = waves.image((240, 260), shift=shift, noise=noise, rng=rng)
    px = CornerDetector().detect(first, 100, None, 12.0, 60.0).px
    truth = px - shift
    sources = np.stack([cut(first, place, 25) for place in px])
    templates = warp(sources, np.repeat(np.eye(2)[None], len(px), axis=0))
    guess = truth + SPREAD_PX * rng.normal(size=truth.shape)
    matches = search(then, templates, guess, np.repeat(SPREAD_PX**2 * np.eye(2)[None], len(px), axis=0))
    found = (matches.score >= 0.7) & np.isfinite(matches.cov).all(axis=(1, 2))
    return (matches.px - truth)[found], matches.cov[found]


@pytest.mark.parametrize("noise", [3.0, 8.0])
def test_covariances_are_those_of_the_errors(noise):
    """Mean normalised squared error of 2 degrees of freedom: from cautious because of the floor to a little bold."""
    several = [errors(noise, seed) for seed in range(3)]
    error, cov = (np.concatenate([one[part] for one in several]) for part in (0, 1))
    good = np.abs(error).max(axis=1) <= WRONG_PX
    squared = np.einsum("ki,kij,kj->k", error[good], np.linalg.inv(cov[good]), error[good])
    assert good.sum() > 150 and 1.2 < squared.mean() < 3.0
