"""Renders textured rectangles by ray casting, with exact geometry and filtered textures."""

import math
from collections.abc import Sequence

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.validation.simulation.textured_scene import Rectangle, rays_to_sides, sides

NEAR_M = 1e-3  #: Distance of the near plane.


class Renderer:
    """Renders images of rectangles for one camera.

    Grey levels are linear in light. A pixel is the mean of grid² rays on a rotated grid within it; each samples the
    texture at the level of detail of its part of the pixel, interpolated between the two nearest levels.
    """

    def __init__(self, rectangles: Sequence[Rectangle], camera: Pinhole, grid: int = 2) -> None:
        from rbpf.validation.simulation import raster_kernel

        self._kernel = raster_kernel
        self._grid = grid
        rows, columns = np.mgrid[: camera.height, : camera.width].astype(float)
        px = np.stack([columns, rows], axis=-1)
        self._uv = camera.unproject(px)
        self._slope = np.ascontiguousarray(camera.unproject_jacobian(px)).reshape(*px.shape[:2], 4)
        # Bounds of u and v (J, I, 4) of each tile, including its pixels' full area.
        reach = 0.5 * np.abs(self._slope).reshape(*self._uv.shape[:2], 2, 2).sum(axis=-1)
        around, side = np.concatenate([self._uv - reach, self._uv + reach], axis=-1), raster_kernel.TILE
        tops, lefts = range(0, camera.height, side), range(0, camera.width, side)
        tiles = [_extent(around[y : y + side, x : x + side].reshape(1, -1, 2))[0] for y in tops for x in lefts]
        self._tiles = np.array(tiles).reshape(len(tops), len(lefts), 4)
        self._sides = sides(rectangles)
        sheets = {id(r.texture): r.texture for r in rectangles}
        place = {key: k for k, key in enumerate(sheets)}
        self._sheet = np.array([place[id(r.texture)] for r in rectangles], dtype=np.int64)
        self._gain = np.array([r.gain for r in rectangles])
        self._levels, self._texels = _packed(list(sheets.values()))
        across, down, corner = np.moveaxis(self._sides, 1, 0)
        # (S, 4, 3) in order around each rectangle.
        self._corners = np.stack([corner, corner + across, corner + across + down, corner + down], axis=1)

    def image(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Grey levels (H, W) float32 of an image at a pose (7,), or at poses (K, 7) of a moving camera.

        With K poses it is the mean over them: the rays of a pixel are distributed over the poses, so K must be the square
        of a whole number, at least grid².
        """
        poses = np.atleast_2d(world_from_camera)
        # Subpixel shifts [px], n² on a rotated grid: i/n² in one direction, n i mod (n² + 1) in the other, centred on 0.
        side = max(self._grid, math.isqrt(len(poses)))
        i = np.arange(1, side * side + 1)
        shifts = (np.stack([i, side * i % (side * side + 1)], axis=-1) - 0.5) / (side * side) - 0.5
        light = np.empty(self._uv.shape[:2], dtype=np.float32)
        self._kernel.expose(
            np.array([rays_to_sides(self._sides, pose) for pose in poses]),
            np.array([self._bounds(pose) for pose in poses]),
            np.arange(len(shifts)) % len(poses),
            self._sheet,
            self._gain,
            self._uv,
            self._slope,
            self._tiles,
            shifts,
            1.0 / self._grid,
            self._levels,
            self._texels,
            light,
        )
        return light

    def depth(self, world_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth z (H, W) [m] and rectangles (H, W) at the pixels' centres; infinite and -1 without a hit."""
        inverse = np.empty(self._uv.shape[:2])
        rows = np.empty(inverse.shape, dtype=np.int64)
        h, bounds = rays_to_sides(self._sides, world_from_camera), self._bounds(world_from_camera)
        self._kernel.trace(h, bounds, self._uv, self._slope, self._tiles, inverse, rows)
        with np.errstate(divide="ignore"):
            return 1.0 / inverse, rows

    def _bounds(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Bounds (S, 4) of u and v of the rectangles' parts in front of the camera; empty if there is none."""
        local = SE3.inverse_transform(world_from_camera, self._corners.reshape(-1, 3)).reshape(-1, 4, 3)
        following = np.roll(local, -1, axis=1)
        with np.errstate(all="ignore"):
            fraction = (NEAR_M - local[..., 2:]) / (following[..., 2:] - local[..., 2:])
            cut = local + fraction * (following - local)
            outline = np.concatenate([local, cut], axis=1)
            crossed = (fraction[..., 0] >= 0.0) & (fraction[..., 0] <= 1.0)
            seen = np.concatenate([local[..., 2] >= NEAR_M, crossed], axis=1)
            depth = np.where(seen, np.maximum(outline[..., 2], NEAR_M), np.nan)[..., None]
            uv = outline[..., :2] / depth
        return _extent(uv.reshape(len(uv), -1, 2))


def _extent(uv: np.ndarray) -> np.ndarray:
    """Bounds (R, 4) of (R, K, 2), ignoring NaN."""
    low = np.where(np.isnan(uv), np.inf, uv).min(axis=1)
    high = np.where(np.isnan(uv), -np.inf, uv).max(axis=1)
    return np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=-1)


def _packed(textures: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Start, height and width (S, L, 3) of every level of each texture, the last one repeated, and all texels concatenated.

    A level averages 2 × 2 texels of the one before, until a side is one texel; an odd side is resampled to half of it, rounded
    down, so that all levels cover the same rectangle. Each level has a border that repeats its outermost texels, so that
    interpolation needs no special case at the edge.
    """
    import cv2

    depths = [min(texture.shape).bit_length() for texture in textures]
    levels = np.empty((len(textures), max(depths), 3), dtype=np.int64)
    start, texels = 0, []
    for k, (texture, depth) in enumerate(zip(textures, depths, strict=True)):
        for level in range(depth):
            if level:
                height, width = texture.shape
                texture = np.asarray(cv2.resize(texture, (width // 2, height // 2), interpolation=cv2.INTER_AREA))
            levels[k, level:] = start, *texture.shape
            texels.append(np.pad(texture, 1, mode="edge").ravel())
            start += texels[-1].size
    return levels, np.concatenate(texels)
