"""The laboratory as a world of points, for what needs no pictures: the same rooms, furniture and drives."""

from dataclasses import dataclass, field

import numpy as np

from rbpf.validation.simulation import lab_plan, textures
from rbpf.validation.simulation.lab_furniture import Surface, furnished, shell
from rbpf.validation.simulation.limits import check_counts
from rbpf.validation.simulation.scene import Scene, frame_stamps, outside
from rbpf.validation.simulation.textured_lab import LabDrive, world_from_camera

PRINTED = {textures.picture, textures.page, textures.carton, textures.spines}
RICH = 20.0
"""What is printed has so many times as many points per area as what is painted, of wood or a carpet."""


@dataclass(frozen=True)
class LabWorld:
    """Points on all that can be seen in the `TexturedLab`; the same seed furnishes both alike.

    All boxes hide what is behind them. Measure it with any camera:

        >>> from rbpf.validation.simulation.features import STEREO, Measuring, simulate_features
        >>> log = simulate_features(LabWorld(LabDrive(frames=3), points=3000), Measuring(known=0), STEREO, seed=0)
        >>> len(log.frames), log.frames[0].z.shape
        (3, (25, 3))

    Attributes:
        drive: of the robot that carries the camera.
        points: number of points.
    """

    drive: LabDrive = field(default_factory=LabDrive)
    points: int = 12000

    def __post_init__(self) -> None:
        check_counts(self, {"points": 1})

    def build(self, rng: np.random.Generator) -> Scene:
        """Draws the furniture and the points."""
        lab = furnished(rng)
        surfaces = [*lab.surfaces, *(surface for surface, _ in shell())]
        blocks = np.array(lab.blocks)
        points = outside(lambda count: _on(surfaces, count, rng), blocks)(self.points)
        images = self.drive.images
        path = world_from_camera(self.drive.travelled().world_from_robot)[images]
        stamps = frame_stamps(int(images[-1]) + 1, lab_plan.RATE_HZ)[images]
        present = np.tile([0, len(images)], (self.points, 1))
        return Scene("lab", stamps, path, points, present, blocks)


def _on(surfaces: list[Surface], count: int, rng: np.random.Generator) -> np.ndarray:
    """Positions (K, 3), uniform on each surface."""
    weight = np.array([surface.area_m2 * (RICH if surface.paint in PRINTED else 1.0) for surface in surfaces])
    sides = np.array([[surface.across, surface.down] for surface in surfaces])
    corner = np.array([surface.corner for surface in surfaces])
    row = rng.choice(len(surfaces), count, p=weight / weight.sum())
    return np.asarray(corner[row] + np.einsum("ks,ksx->kx", rng.random((count, 2)), sides[row]))
