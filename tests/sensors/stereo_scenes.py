"""Rendered stereo pairs with their true disparities."""

from functools import cache

import numpy as np

from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.desk_and_room import TexturedRoom
from rbpf.validation.simulation.images import Imaging, Shutter
from rbpf.validation.simulation.render import Renderer

RIG = RectifiedStereo(Pinhole(320, 240, 260.0, 260.0, 159.5, 119.5), 0.12)


@cache
def room(frames=3, every=8, seed=1):
    """Pairs of images, depths (H, W) and rectangles (H, W) of the left ones, and poses (T, 7)."""
    rng = np.random.default_rng(seed)
    scene = TexturedRoom(frames=frames * every, texel_m=0.004).build(rng)
    imaging = Imaging(known=0, noise_std=2.0, blur_s=0.0, exposure_drift=0.0, vignetting=0.0)
    renderer = Renderer(scene.rectangles, RIG.camera, imaging.grid)
    shutter = Shutter(scene, imaging, RIG.camera, renderer, rng)
    chosen = range(0, frames * every, every)
    pairs = [tuple(shutter.images(k, RIG.baseline_m)) for k in chosen]
    depths = [renderer.depth(scene.world_from_camera[k]) for k in chosen]
    return pairs, depths, scene.world_from_camera[list(chosen)]


def true_disparity(depth, px):
    """Of places (K, 2), NaN near the edges of things: 1/z is linear in the image on a plane."""
    z, rows = depth
    column, line = np.floor(px).astype(int).T
    column, line = np.clip(column, 4, z.shape[1] - 6), np.clip(line, 4, z.shape[0] - 6)
    across, down = (px - np.column_stack([column, line])).T
    inverse = 1.0 / z
    upper = inverse[line, column] * (1 - across) + inverse[line, column + 1] * across
    lower = inverse[line + 1, column] * (1 - across) + inverse[line + 1, column + 1] * across
    value = RIG.camera.fx * RIG.baseline_m * (upper * (1 - down) + lower * down)
    offsets = [(dx, dy) for dx in (-4, 0, 5) for dy in (-4, 0, 5)]
    same = np.all([rows[line + dy, column + dx] == rows[line, column] for dx, dy in offsets], axis=0)
    return np.where(same, value, np.nan)
