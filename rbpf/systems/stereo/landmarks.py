"""Where a map's landmarks were seen last: facts that need not differ between particles, to find candidates by."""

from dataclasses import dataclass, fields
from typing import final

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import RectifiedStereo
from rbpf.systems.stereo.config import MapConfig

SIGMAS = 3.0
"""The image is widened by so many standard deviations of the camera's direction."""


@dataclass
class _Rows:
    """One row per landmark or candidate ever started, which is its name.

    Attributes:
        place: (F, 3) in the world of the heaviest particle, when it was seen last.
        seen_from: (F, 3) where that particle's camera was then.
    """

    place: np.ndarray
    seen_from: np.ndarray


@final
class Places:
    """A growing table of landmarks.

    Args:
        rig: the cameras.
        config: how far a landmark may be from how it was seen.
    """

    def __init__(self, rig: RectifiedStereo, config: MapConfig) -> None:
        self.rig = rig
        self.config = config
        self._rows = _Rows(np.zeros((0, 3)), np.zeros((0, 3)))

    def put(self, names: np.ndarray, place: np.ndarray, world_from_camera: np.ndarray) -> None:
        """Landmarks (k,) are seen at places (k, 3) from one camera (7,)."""
        self._reserve(int(names.max(initial=-1)) + 1)
        self._rows.place[names] = place
        self._rows.seen_from[names] = SE3.translation(world_from_camera)

    def in_view(self, names: np.ndarray, world_from_camera: np.ndarray, doubt_rad: float = 0.0) -> np.ndarray:
        """Those of landmarks (M,) that a camera (7,), whose direction is in some doubt, may see and know again."""
        camera = self.rig.camera
        margin = self.config.margin_px + min(SIGMAS * camera.fx * doubt_rad, 0.5 * camera.width)
        local = SE3.inverse_transform(world_from_camera, self._rows.place[names])
        names = names[self._in_image(local, margin)]
        place = self._rows.place[names]
        then = place - self._rows.seen_from[names]
        now = place - SE3.translation(world_from_camera)
        lengths = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
        cosine = (then * now).sum(axis=1) / np.maximum(lengths[0] * lengths[1], 1e-300)
        ratio = np.abs(np.log(lengths[1] / np.maximum(lengths[0], 1e-300)))
        alike = (cosine >= np.cos(np.deg2rad(self.config.turn_deg))) & (ratio <= np.log(self.config.scale))
        return np.asarray(names[alike])

    def _in_image(self, local: np.ndarray, margin: float) -> np.ndarray:
        """Rows of points (M, 3) in the camera's frame that are in both images, or nearly; most are far from it."""
        camera = self.rig.camera
        across = (max(camera.cx, camera.width - camera.cx) + margin) / camera.fx
        down = (max(camera.cy, camera.height - camera.cy) + margin) / camera.fy
        x, y, z = local.T
        rows = np.flatnonzero((z > 0.0) & (np.abs(x) <= across * z) & (np.abs(y) <= down * z))
        return rows[self.rig.visible(local[rows], -margin)]

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {f"places/{item.name}": getattr(self._rows, item.name) for item in fields(_Rows)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._rows = _Rows(*(arrays[f"places/{item.name}"].copy() for item in fields(_Rows)))

    def _reserve(self, count: int) -> None:
        room = self._rows.place.shape[0]
        if count <= room:
            return
        extra = max(count, 2 * room, 64) - room
        for item in fields(_Rows):
            column = getattr(self._rows, item.name)
            setattr(self._rows, item.name, np.concatenate([column, np.zeros((extra, 3))]))
