"""Simulated worlds of the paper's figures."""

from dataclasses import dataclass, replace

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import KnownPixels
from rbpf.validation.simulation import textures
from rbpf.validation.simulation.desk_and_room import OVER_DESK, TexturedDesk
from rbpf.validation.simulation.paths import UP, HandHeld, Wave, eased, looking
from rbpf.validation.simulation.textured_scene import Rectangle, TexturedScene, stamps_ns

RATE_HZ = 30.0
TREMOR_HZ = 0.5, 2.0
TREMOR = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])
"""Largest deviation of the hand from the path, rad and m."""


def flat_desk(frames: int, texel_m: float) -> TexturedDesk:
    """A table with papers and no other objects, large enough to fill the view. About 1 m² comes into view."""
    return TexturedDesk(
        frames=frames,
        size_m=(4.0, 4.0),
        papers=160,
        things=0,
        hand=HandHeld(nearest_m=0.6, farthest_m=0.85, wander=0.06),
        texel_m=texel_m,
    )


@dataclass(frozen=True)
class LoopOverDesk:
    """A camera that faces down to a desk and moves in a circle, past its start.

    Attributes:
        frames: number of images.
        radius_m: of the circle.
        away_m: distance of the camera from its target.
        down_deg: angle at which it faces down.
        laps: number of laps.
        texel_m: side of a texel.
    """

    frames: int = 480
    radius_m: float = 0.7
    away_m: float = 0.75
    down_deg: float = 55.0
    laps: float = 1.12
    texel_m: float = 0.001

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws desk and path."""
        desk = TexturedDesk(frames=2, size_m=(3.5, 3.5), papers=120, things=24, texel_m=self.texel_m).build(rng)
        stamps = stamps_ns(self.frames, RATE_HZ)
        return replace(desk, name="loop", stamps_ns=stamps, world_from_camera=self._path(rng))

    def _path(self, rng: np.random.Generator) -> np.ndarray:
        seconds = np.arange(self.frames) / RATE_HZ
        time = eased(seconds, 1.0)
        turn = 2.0 * np.pi * self.laps * time / time[-1] - 0.5 * np.pi
        gaze = self.radius_m * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
        down = np.deg2rad(self.down_deg)
        forward = np.broadcast_to([0.0, np.cos(down), -np.sin(down)], gaze.shape)
        poses = looking(gaze - self.away_m * forward, forward)
        return SE3.retract(poses, Wave.random(TREMOR, TREMOR_HZ, rng)(time))


@dataclass(frozen=True)
class SidewaysDesk:
    """A desk that a camera passes in a straight line, to the right and slightly forwards.

    Attributes:
        frames: number of images.
        step_m: per image, in the camera's frame.
        texel_m: side of a texel.
    """

    frames: int = 11
    step_m: tuple[float, float, float] = (0.02, 0.0, 0.004)
    texel_m: float = 0.001

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws desk and path."""
        desk = TexturedDesk(
            frames=2, hand=replace(OVER_DESK, nearest_m=1.6, farthest_m=1.9), texel_m=self.texel_m
        ).build(rng)
        shift = np.arange(self.frames)[:, None] * np.array([0.0, 0.0, 0.0, *self.step_m])
        poses = SE3.retract(np.tile(desk.world_from_camera[0], (self.frames, 1)), shift)
        return replace(desk, stamps_ns=stamps_ns(self.frames, RATE_HZ), world_from_camera=poses)


@dataclass(frozen=True)
class StillTarget:
    """A camera at rest facing a small flat poster at a distance, and other sheets nearer and farther (figure 9).

    The camera is at the origin and faces along x.

    Attributes:
        frames: number of images.
        distance_m: of the poster's centre.
        side_m: of the poster.
        tilt_deg: rotation of the poster about the vertical.
        sheets: number of others.
        texel_m: side of a texel on the poster.
    """

    frames: int = 60
    distance_m: float = 3.0
    side_m: float = 0.3
    tilt_deg: float = 20.0
    sheets: int = 10
    texel_m: float = 0.003

    def build(self, rng: np.random.Generator) -> TexturedScene:
        """Draws the sheets."""
        wall = self._facing(np.array([6.0, 0.0, 0.0]), 0.0, (14.0, 10.0), 0.02, textures.wallpaper, rng)
        around = np.linspace(0.0, 2.0 * np.pi, self.sheets, endpoint=False)
        sheets = []
        for angle, depth in zip(around, rng.permutation(np.linspace(1.2, 5.0, self.sheets)), strict=True):
            middle = depth * np.array([1.0, 0.38 * np.cos(angle), 0.28 * np.sin(angle)])
            size = 0.12 * depth, 0.1 * depth
            sheets.append(self._facing(middle, rng.uniform(-30, 30), size, 0.0015 * depth, textures.picture, rng))
        poster = self._poster(rng)
        path = looking(np.zeros((self.frames, 3)), np.tile([1.0, 0.0, 0.0], (self.frames, 1)))
        return TexturedScene("target", stamps_ns(self.frames, RATE_HZ), path, [wall, *sheets, poster])

    def known(self, camera: Pinhole, std_m: float, noise_px: float, rng: np.random.Generator) -> KnownPixels:
        """The corners of the poster's print and their pixels, both with errors."""
        across, down = self._sides()
        signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        positions = np.array([self.distance_m, 0.0, 0.0]) + 0.5 * signs @ np.array([across, down])
        pose = looking(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))[0]
        px = camera.project(SE3.inverse_transform(pose, positions))
        px = px + noise_px * rng.standard_normal(px.shape)
        positions = positions + std_m / np.sqrt(3.0) * rng.standard_normal(positions.shape)
        return KnownPixels(np.arange(1, 5), px, positions, np.full(4, std_m))

    def _poster(self, rng: np.random.Generator) -> Rectangle:
        """A dark square, whose corners are the known points, with a grey, mottled margin."""
        texels = 6 * max(2, round(0.25 * self.side_m / self.texel_m))
        paper = textures.grey_levels(200.0 + 6.0 * textures.clouds((texels, texels), rng))
        edge = texels // 6
        paper[edge:-edge, edge:-edge] = 40
        across, down = (1.5 * side for side in self._sides())
        middle = np.array([self.distance_m, 0.0, 0.0])
        return Rectangle(middle - 0.5 * across - 0.5 * down, across, down, paper)

    def _sides(self) -> tuple[np.ndarray, np.ndarray]:
        """The poster's dark square, across and down (3,), m."""
        tilt = np.deg2rad(self.tilt_deg)
        return self.side_m * np.array([np.sin(tilt), -np.cos(tilt), 0.0]), -self.side_m * UP

    def _facing(
        self,
        middle: np.ndarray,
        yaw_deg: float,
        size: tuple[float, float],
        texel_m: float,
        paint: textures.Paint,
        rng: np.random.Generator,
    ) -> Rectangle:
        yaw = np.deg2rad(yaw_deg)
        across, down = size[0] * np.array([np.sin(yaw), -np.cos(yaw), 0.0]), -size[1] * UP
        texture = paint((max(8, round(size[1] / texel_m)), max(8, round(size[0] / texel_m))), rng)
        return Rectangle(middle - 0.5 * across - 0.5 * down, across, down, texture)
