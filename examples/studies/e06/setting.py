"""Common to the figures: sizes, rendered sequences, and rows of the table."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import ImageSequence, KnownPixels, open_images, read_known_points
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.textured_scene import ImageWorld

QUICK_WIDTH = 320
FOCAL_WIDTHS = 0.82
"""Focal length as a fraction of the image's width: the field of view is 63 degrees."""


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        figure: of the paper.
        what: the compared quantity.
        paper: the paper's value, in words.
        ours: our value, in words.
        value: our value as a number.
        met: whether it meets the requirement; None without one.
    """

    figure: str
    what: str
    paper: str
    ours: str
    value: float
    met: bool | None = None

    @property
    def verdict(self) -> str:
        """Whether the requirement is met, in words."""
        return "" if self.met is None else "yes" if self.met else "FALLS SHORT"


@dataclass(frozen=True)
class Setting:
    """Folder and sizes of the figures.

    Attributes:
        out: folder for plots; rendered sequences are in its `sequences`.
        width: of the images, px.
        particles: of the filter.
        seed: of worlds, noise and filter.
        quick: few small frames, for a test.
        map: the paper's kind, or "auto" for the system's default.
    """

    out: Path
    width: int = 640
    particles: int = 50
    seed: int = 0
    quick: bool = False
    map: Literal["particles", "auto"] = "particles"

    @property
    def camera(self) -> Pinhole:
        """Without distortion."""
        width = QUICK_WIDTH if self.quick else self.width
        height, focal = 3 * width // 4, FOCAL_WIDTHS * width
        return Pinhole(width, height, focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5)

    def config(self, ray: InverseDepthConfig | None = None) -> MonoConfig:
        """Of a run: the defaults but the map."""
        config = MonoConfig(particles=self.particles, seed=self.seed, map=self.map)
        return config if ray is None else replace(config, inverse_depth=ray)

    def sequence(
        self, name: str, world: ImageWorld, imaging: Imaging | None = None
    ) -> tuple[ImageSequence, KnownPixels | None]:
        """A world's images and known points; rendered unless they exist."""
        imaging = imaging or Imaging()
        folder = self.out / "sequences" / f"{name}_{self.camera.width}"
        if not folder.exists():
            simulate_images(world, replace(imaging, grid=1) if self.quick else imaging, self.camera, folder, self.seed)
        points = folder / "known_points.csv"
        return open_images(folder), read_known_points(points) if points.exists() else None


def true_poses(sequence: ImageSequence) -> np.ndarray:
    """(T, 7) true world_from_camera of a sequence's images that have ground truth at or near their times."""
    assert sequence.truth is not None
    after = np.searchsorted(sequence.truth.stamps_ns, sequence.stamps_ns).clip(1, sequence.truth.stamps_ns.size - 1)
    stamps = sequence.truth.stamps_ns
    nearer = np.where(sequence.stamps_ns - stamps[after - 1] < stamps[after] - sequence.stamps_ns, after - 1, after)
    return np.asarray(sequence.truth.poses[nearer])
