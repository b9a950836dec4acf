"""How well patches are found: textures with known motion, and pairs of real images."""

import numpy as np
import pytest

from rbpf.sensors.features import CornerDetector
from rbpf.sensors.patches.search import cut, search, warp
from tests.sensors.patch_scenes import Waves, window

SHAPE = (240, 260)
MIDDLE = (np.array(SHAPE[::-1]) - 1) / 2
SPREAD_PX = 2.0
COV = SPREAD_PX**2 * np.eye(2)
WRONG_PX = 1.5
"""A place further from the truth is a wrong match."""


def errors(affine, blur_px=0.5, noise=2.0, seed=0, accept=0.7):
    """Errors (k, 2) and covariances of accepted matches between two views, and how many were looked for."""
    rng, shift = (
        np.random.default_rng(seed),
        np.array([0.31, -0.42]) + np.random.default_rng(seed).uniform(-1, 1, 2),
    )
    waves = Waves(seed, blur_px=blur_px)
    first = waves.image(SHAPE, noise=noise, rng=rng)
    then = waves.image(SHAPE, affine, shift, noise, rng)
    px = CornerDetector().detect(first, 100, None, 12.0, 60.0).px
    truth = MIDDLE + (px - MIDDLE - shift) @ np.linalg.inv(affine).T
    sources = np.stack([cut(first, place, 25) for place in px])
    templates = warp(sources, np.repeat(affine[None], len(px), axis=0))
    guess = truth + SPREAD_PX * rng.normal(size=truth.shape)
    matches = search(then, templates, guess, np.repeat(COV[None], len(px), axis=0))
    found = (matches.score >= accept) & np.isfinite(matches.cov).all(axis=(1, 2))
    return (matches.px - truth)[found], matches.cov[found], len(px)


def turned(angle, scale=1.0):
    return scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize(
    "affine",
    [
        np.eye(2),
        turned(0.6),
        turned(3.0),
        turned(0.0, 1.5),
        turned(0.4, 0.75),
        np.array([[1.2, 0.3], [-0.1, 0.8]]),
    ],
    ids=["shift", "turn", "half turn", "smaller", "turned and larger", "sheared"],
)
def test_known_motion_is_recovered(affine):
    error, _, tried = errors(affine)
    assert tried >= 30 and len(error) >= 0.95 * tried
    wrong = np.abs(error).max(axis=1) > WRONG_PX
    assert wrong.mean() <= 0.02
    assert np.sqrt((error[~wrong] ** 2).mean()) < 0.1


@pytest.mark.parametrize(
    ("noise", "blur_px", "hits", "std_px"),
    [
        (0.0, 0.5, 0.98, 0.03),
        (3.0, 0.5, 0.98, 0.05),
        (8.0, 0.5, 0.97, 0.10),
        (15.0, 0.5, 0.60, 0.20),
        (3.0, 1.0, 0.98, 0.06),
        (3.0, 1.5, 0.97, 0.09),
    ],
)
def test_hit_rate_and_accuracy_under_noise(noise, blur_px, hits, std_px):
    """Right matches among those looked for, and their errors without bias."""
    several = [errors(np.eye(2), blur_px, noise, seed) for seed in range(4)]
    error, tried = np.concatenate([one[0] for one in several]), sum(one[2] for one in several)
    right = error[np.abs(error).max(axis=1) <= WRONG_PX]
    assert len(right) >= hits * tried and len(error) - len(right) <= 0.03 * tried
    assert np.sqrt((right**2).mean()) < std_px
    assert np.abs(right.mean(axis=0)).max() < 0.3 * std_px + 0.006


@pytest.mark.parametrize("noise", [3.0, 8.0])
def test_covariances_are_those_of_the_errors(noise):
    """Mean normalised squared error of 2 degrees of freedom: from cautious because of the floor to a little bold."""
    several = [errors(np.eye(2), 0.7, noise, seed) for seed in range(3)]
    error, cov = (np.concatenate([one[part] for one in several]) for part in (0, 1))
    good = np.abs(error).max(axis=1) <= WRONG_PX
    squared = np.einsum("ki,kij,kj->k", error[good], np.linalg.inv(cov[good]), error[good])
    assert good.sum() > 150 and 1.2 < squared.mean() < 3.0


@pytest.mark.real_data
def test_found_forth_and_back_in_real_images(data_dir):
    """Corners of one image are found in one a few frames later, and from there back where they were."""
    import cv2

    paths = sorted((data_dir / "mono_redkitchen_a" / "rgb").glob("*.jpg"))
    first, then = (cv2.imread(str(paths[i]), cv2.IMREAD_GRAYSCALE) for i in (0, 3))
    px = CornerDetector().detect(first, 60, None, 25.0, 30.0).px
    assert len(px) == 60
    wide = np.repeat(100.0 * np.eye(2)[None], 60, axis=0)
    forth = search(then, np.stack([window(first, place, 11) for place in px]), px, wide)
    good = np.flatnonzero((forth.score > 0.9) & (forth.ratio < 0.9))
    assert good.size >= 40
    cuts = [cut(then, place, 5) for place in forth.px[good]]
    inside = np.array([k for k, piece in enumerate(cuts) if piece is not None])
    back = search(first, np.stack([cuts[k] for k in inside]), px[good[inside]], wide[: inside.size])
    apart = np.linalg.norm(back.px - px[good[inside]], axis=1)
    assert np.median(apart) < 0.05 and np.mean(apart < 0.5) > 0.9
