"""Pictures of a chessboard by a camera that is known, with the simulator."""

from functools import cache

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.calibration import Board
from rbpf.sensors.camera import Pinhole
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import Furniture
from rbpf.validation.simulation.textures import wood

BOARD = Board(9, 6, 0.024)
CAMERA = Pinhole(640, 480, 520.0, 523.0, 330.0, 236.0, (-0.25, 0.08, 0.001, -0.0015, 0.0))

FISHEYE = Pinhole(640, 480, 262.0, 264.0, 322.0, 236.0, (-0.03, 0.02, -0.012, 0.002), "equidistant")


def directions(count: int, seed=5, tilts=(0.15, 0.7), distances=(0.24, 0.36), shift=0.03, aside=0.0) -> np.ndarray:
    """Poses (count, 7) of a camera around a board at the origin that lies face up: tilted, turned, near and far."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        tilt, around = rng.uniform(*tilts), 2.0 * np.pi * k / count
        distance = rng.uniform(*distances)
        aim = np.append(rng.uniform(-shift, shift, 2), 0.0)
        back = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
        at = aim + distance * back
        if aside:
            aim = aim + np.append(rng.uniform(-aside, aside, 2), 0.0)
        roll, z = rng.uniform(-0.5, 0.5), (aim - at) / np.linalg.norm(aim - at)
        x = np.cross(z, [np.sin(roll), np.cos(roll), 0.0])
        x /= np.linalg.norm(x)
        poses.append(SE3.from_matrix(np.column_stack([x, np.cross(z, x), z, at])))
    return np.array(poses)


def nearby(count: int) -> np.ndarray:
    """Poses (count, 7) of a wide camera: so near that the board reaches the borders of its image."""
    return directions(count, 3, (0.1, 0.8), (0.10, 0.25), 0.05, 0.15)


@cache
def pictures(count: int = 12, camera: Pinhole = CAMERA, noise: float = 2.0) -> tuple[np.ndarray, ...]:
    """Images (H, W) uint8 from all these directions; a fisheye camera's from near by."""
    desk = Furniture(np.random.default_rng(0), 0.002, 1.0)
    desk.flat(np.array([0.0, 0.0, -0.001]), 0.0, (1.5, 1.5), wood)
    desk.board(np.zeros(3), (BOARD.columns + 1, BOARD.rows + 1), BOARD.square_m)
    renderer = Renderer(desk.rectangles, camera, grid=4)
    rng = np.random.default_rng(1)
    images = []
    for pose in directions(count) if camera.distortion_model != "equidistant" else nearby(count):
        light = renderer.image(pose)
        images.append(np.clip(light + rng.normal(0.0, noise, light.shape), 0, 255).astype(np.uint8))
    return tuple(images)
