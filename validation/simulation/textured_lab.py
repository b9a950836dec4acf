"""A laboratory of two rooms, to take pictures of from a robot with a stereo camera (S05 §V). Z points up."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.validation.simulation import lab_plan
from rbpf.validation.simulation.driven_paths import Travelled
from rbpf.validation.simulation.furniture import Furniture
from rbpf.validation.simulation.lab_furniture import furnished, shell
from rbpf.validation.simulation.limits import check_counts, check_not_negative, check_positive
from rbpf.validation.simulation.textured_scene import TexturedScene, stamps_ns
from rbpf.validation.simulation.wheel_odometer import WheelOdometer

Trajectory = Literal["tour", "turn_back"]

ROBOT_FROM_CAMERA = SE3.from_matrix(
    np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.06], [0.0, -1.0, 0.0, 1.0]])
)
"""(7,) the left camera looks forwards, 1 m above the floor, from a little before and to the left of the wheels' middle;
the robot's frame has x forwards, y to the left, z up, its origin between the wheels on the floor."""


@dataclass(frozen=True)
class LabDrive:
    """How a robot drives through the laboratory.

    Attributes:
        trajectory: "tour" through both rooms and back, 4,000 frames over 67.9 m; or "turn_back", 600 frames, on which
            the robot twice looks away for 5 s and back.
        frames: most images; None for all.
        every: only each so many-th frame of the trajectory becomes an image.

    Raises:
        InputError: there is no such trajectory, or it has not as many frames.
    """

    trajectory: Trajectory = "tour"
    frames: int | None = None
    every: int = 1

    def __post_init__(self) -> None:
        check_counts(self, {"every": 1})
        if self.trajectory not in DRIVES:
            raise InputError(f"trajectory must be one of {', '.join(DRIVES)}, got {self.trajectory!r}")
        if self.frames is not None:
            check_counts(self, {"frames": 2})
        if not 2 <= self._count <= self._most:
            raise InputError(
                f"with every = {self.every} the {self.trajectory} has {self._most} images, of which at least 2 are "
                f"needed, got frames = {self.frames}"
            )

    @property
    def images(self) -> np.ndarray:
        """(T,) the frames of the trajectory that become images."""
        return np.arange(self._count) * self.every

    @property
    def _most(self) -> int:
        """Images of the whole trajectory."""
        return -(-DRIVES[self.trajectory][1] // self.every)

    @property
    def _count(self) -> int:
        return self._most if self.frames is None else self.frames

    def travelled(self) -> Travelled:
        """The robot in every frame of the trajectory up to the last image."""
        drive, _ = DRIVES[self.trajectory]
        return drive()(np.arange(self.images[-1] + 1) / lab_plan.RATE_HZ)


DRIVES = {
    "tour": (lab_plan.tour, lab_plan.TOUR_FRAMES),
    "turn_back": (lab_plan.turn_back, lab_plan.TURN_BACK_FRAMES),
}
"""A drive and its number of frames, by name."""


def world_from_camera(world_from_robot: np.ndarray) -> np.ndarray:
    """(T, 7) poses of the left camera for poses (T, 3) of the robot, elements of SE(2)."""
    theta, x, y = world_from_robot.T
    still = np.zeros_like(theta)
    return SE3.compose(SE3.from_ypr(np.stack([x, y, still], axis=-1), theta, still, still), ROBOT_FROM_CAMERA)


@dataclass(frozen=True)
class TexturedLab:
    """Two rooms of 18 m × 10 m together, with shelves, tables, cabinets, cartons and posters.

    Attributes:
        drive: of the robot that carries the camera.
        odometer: of the same robot; it is read in every frame of the trajectory, whether that becomes an image or not.
        texel_m: side of a texel; of floors twice, of the ceiling four times as much.
        contrast: of all textures; 1 is rich, 0.1 poor.
    """

    drive: LabDrive = LabDrive()
    odometer: WheelOdometer = field(default_factory=WheelOdometer)
    texel_m: float = 0.003
    contrast: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self, "texel_m")
        check_not_negative(self, "contrast")

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws the furniture, the textures and the odometer's slip; the drive is always the same.

        A shorter drive leaves all that is drawn as it is.
        """
        slip = rng.spawn(1)[0]
        lab = furnished(rng)
        rectangles = []
        for surface, coarse in [*shell(), *((surface, 1.0) for surface in lab.surfaces)]:
            furniture = Furniture(rng, coarse * self.texel_m, self.contrast)
            furniture.sheet(surface.corner, surface.across, surface.down, surface.paint)
            rectangles += furniture.rectangles
        images, travelled = self.drive.images, self.drive.travelled()
        path = world_from_camera(travelled.world_from_robot)[images]
        stamps = stamps_ns(int(images[-1]) + 1, lab_plan.RATE_HZ)
        odometry = self.odometer.measure(travelled, stamps, ROBOT_FROM_CAMERA, slip)
        return TexturedScene("lab", stamps[images], path, rectangles, odometry=odometry)
