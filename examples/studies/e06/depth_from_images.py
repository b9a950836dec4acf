"""Figure 2 from images: depth and inverse depth of features tracked from image to image."""

import numpy as np

from examples.studies.e06.depth_curves import Passing, Shape, draw_curves, shape_of
from examples.studies.e06.setting import Row, Setting, true_poses
from examples.studies.e06.worlds import SidewaysDesk
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.plots import save_figures
from rbpf.sensors.features import CornerDetector
from rbpf.sensors.patches.search import cut, search, warp
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.mono.config import SearchConfig
from rbpf.systems.mono.feature_table import PATCH_HALF_PX
from rbpf.validation.simulation.textured_scene import cast

NEAREST_M, FARTHEST_M = 0.2, 20.0
FEATURES = 40
AROUND_PX = 4.0
"""A feature is searched within three times this of its last position."""
EARLY = 1
"""Number of observations after which the paper's depth estimates are far from Gaussian."""


def follow(sequence: ImageSequence, count: int, config: SearchConfig) -> tuple[np.ndarray, np.ndarray]:
    """First positions (F, 2) of corners, and their tracked positions in later images (F, K, 2); NaN if not found."""
    images = [frame.image for frame in sequence.frames()]
    first = images[0]
    assert first is not None
    px = CornerDetector().detect(first, count, None, config.spacing_px, PATCH_HALF_PX + 1.0).px
    windows = [cut(first, place, PATCH_HALF_PX) for place in px]
    source = np.array([window for window in windows if window is not None])
    templates = warp(source, np.tile(np.eye(2), (len(px), 1, 1)), config.template_px)
    track = np.full((len(px), len(images) - 1, 2), np.nan)
    at, wide = px.copy(), np.tile(AROUND_PX**2 * np.eye(2), (len(px), 1, 1))
    step = np.zeros_like(px)
    for k, image in enumerate(images[1:]):
        assert image is not None
        matches = search(image, templates, at + step, wide)
        good = matches.score >= config.min_correlation
        track[good, k] = matches.px[good]
        step[good], at[good] = matches.px[good] - at[good], matches.px[good]
    return px, track


def reproduce(setting: Setting) -> list[Row]:
    """Tracks corners past a desk, and compares the differences of both likelihoods from Gaussians."""
    world = SidewaysDesk(texel_m=0.003 if setting.quick else 0.001)
    sequence, _ = setting.sequence("sideways", world)
    config = SearchConfig()
    px, track = follow(sequence, 10 if setting.quick else FEATURES, config)
    whole = np.isfinite(track).all(axis=(1, 2))
    px, track = px[whole], track[whole]
    truth = true_poses(sequence)
    poses = SE3.between(np.tile(truth[0], (len(truth) - 1, 1)), truth[1:])
    passing = Passing(setting.camera, poses, config.noise_px)
    curves = _curves(passing, px, track, 1000 if setting.quick else 4000)
    divergence, skewness = (_figures(curves, name) for name in ("divergence", "skewness"))
    scene = world.build(np.random.default_rng(setting.seed))
    distance, _ = cast(scene.rectangles, scene.world_from_camera[0], setting.camera.unproject(px))
    chosen = int(np.argsort(divergence[0, :, EARLY - 1])[px.shape[0] // 2])
    shown = {name: (grid, shapes[chosen]) for name, (grid, shapes) in curves.items()}
    save_figures({"figure_2.png": draw_curves(shown, float(distance[chosen]))}, setting.out)
    medians = np.median(divergence, axis=1), np.median(skewness, axis=1)
    header = ["observations", "KL depth", "KL inverse", "skewness depth", "skewness inverse"]
    table = np.concatenate(medians).T.tolist()
    write_table(
        setting.out / "figure_2.csv", header, [[k, *line] for k, line in enumerate(table, start=1)], shown=False
    )
    return _rows(*medians, px.shape[0])


Curves = dict[str, tuple[np.ndarray, list[list[Shape]]]]
"""Grids by name of the axis, and the shapes for each feature and number of observations."""


def _curves(passing: Passing, px: np.ndarray, track: np.ndarray, cells: int) -> Curves:
    depth = np.linspace(NEAREST_M, FARTHEST_M, cells)
    rho = np.linspace(1.0 / FARTHEST_M, 1.0 / NEAREST_M, cells)
    pairs = list(zip(px, track.reshape(len(px), 1, -1), strict=True))

    def shapes(grid: np.ndarray, inverse: np.ndarray) -> list[list[Shape]]:
        return [[shape_of(grid, one) for one in passing.log_likelihoods(first, inverse, z)] for first, z in pairs]

    return {"depth [m]": (depth, shapes(depth, 1.0 / depth)), "inverse depth [1/m]": (rho, shapes(rho, rho))}


def _figures(curves: Curves, name: str) -> np.ndarray:
    """One of a shape's figures by axis, feature and number of observations (2, F, K)."""
    return np.array([[[getattr(shape, name)[0] for shape in one] for one in shapes] for _, shapes in curves.values()])


def _rows(divergence: np.ndarray, skewness: np.ndarray, count: int) -> list[Row]:
    early, last = EARLY - 1, divergence.shape[1]
    ratio = float(divergence[0, early] / divergence[1, early])
    return [
        Row("Fig. 2", f"{count} features, first observation: divergence of depth and inverse depth from Gaussians [nat]",
            "highly non-Gaussian; nearly Gaussian", f"{divergence[0, early]:.2g} and {divergence[1, early]:.2g}", ratio,
            ratio > 10.0),
        Row("Fig. 2", f"skewness of depth after 1 and {last} observations; of inverse depth", "heavy tail, then a bell",
            f"{skewness[0, early]:.2f}, {skewness[0, -1]:.2f}; {skewness[1, early]:.3f}, {skewness[1, -1]:.3f}",
            float(skewness[0, early])),
    ]  # fmt: skip
