"""How pictures are taken: shutter time, exposure, vignetting, noise, and light that goes out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.validation.simulation.camera_paths import Wave
from rbpf.validation.simulation.limits import (
    check_counts,
    check_fractions,
    check_not_negative,
    check_positive,
)
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import TexturedScene, cast

DRIFT_HZ = 0.1, 0.5

PROBES = 12, 16
"""Rows and columns of pixels at which the motion during an exposure is measured."""

MOST_RAYS = 8
"""Along each side of a pixel: more than 64 px of motion during an exposure is rendered with gaps."""


@dataclass(frozen=True)
class Imaging:
    """How pictures are taken, and what is given along with them.

    The defaults are those of a small camera indoors: an exposure of a hundredth of a second, the noise of a raised
    gain, an automatic exposure, a lens that is darker in the corners. `examples/studies/mono_realism.py` compares what active
    search finds with them with real recordings.

    Attributes:
        noise_std: of the sensor, grey levels.
        exposure_drift: greatest change of the exposure, as a fraction; it goes up and down within seconds.
        lens_px: standard deviation of the lens's point spread; 0 is sharper than any lens.
        blur_s: the shutter is open this long, half before and half after the stamp.
        vignetting: fraction of the light that is missing in the corner farthest from the principal point.
        blackout: frames in which the light is out, counted from 0.
        grid: rays per pixel along each side.
        depth: whether depth images are written.
        jpeg: quality of JPEG files, 1 to 100; 0 writes PNG, which loses nothing.
        known: number of corners in the first image whose positions are given, at least 4; 0 for none.
        known_std_m: standard deviation of these positions, the root of their covariance's trace.
        known_exact: leave the positions without their error.
    """

    noise_std: float = 3.0
    exposure_drift: float = 0.15
    lens_px: float = 0.5
    blur_s: float = 0.01
    vignetting: float = 0.2
    blackout: Sequence[int] = ()
    grid: int = 2
    depth: bool = False
    jpeg: int = 0
    known: int = 6
    known_std_m: float = 0.001
    known_exact: bool = False

    def __post_init__(self) -> None:
        """Checks that the numbers make sense."""
        check_counts(self, {"grid": 1, "known": 0, "jpeg": 0})
        if self.jpeg > 100:
            raise InputError(f"jpeg must be a quality of 1 to 100, or 0 for PNG, got {self.jpeg}")
        check_not_negative(self, "noise_std", "lens_px", "blur_s")
        check_fractions(self, "exposure_drift", "vignetting")
        check_positive(self, "known_std_m")
        if 0 < self.known < 4:
            raise InputError(f"known must be at least 4 points, or 0 for none, got {self.known}")
        if self.known and 0 in self.blackout:
            raise InputError(
                "blackout names frame 0, in which the known points are seen: leave it out or set known = 0"
            )

    @property
    def suffix(self) -> str:
        """Of the images' files."""
        return ".jpg" if self.jpeg else ".png"

    def check_frames(self, frames: int) -> None:
        """Refuses a blackout of frames that there are not."""
        wrong = [frame for frame in self.blackout if not 0 <= frame < frames]
        if wrong:
            raise InputError(f"blackout names frame {wrong[0]}, but the frames are 0 to {frames - 1}")


class Shutter:
    """Takes the pictures of a scene, in any order: a frame's noise depends on nothing but the seed."""

    def __init__(
        self,
        scene: TexturedScene,
        imaging: Imaging,
        camera: Pinhole,
        renderer: Renderer,
        rng: np.random.Generator,
    ) -> None:
        """Draws how the exposure drifts.

        Args:
            scene: the world.
            imaging: the options.
            camera: of each picture.
            renderer: of the same.
            rng: generator.
        """
        self._scene, self._imaging, self._camera, self._renderer = scene, imaging, camera, renderer
        frames = np.arange(len(scene.stamps_ns))
        seconds = 1e-9 * (scene.stamps_ns - scene.stamps_ns[0])
        self._gain = 1.0 + Wave.random(np.array([imaging.exposure_drift]), DRIFT_HZ, rng)(seconds)[:, 0]
        self._gain[list(imaging.blackout)] = 0.0
        before, after = np.maximum(frames - 1, 0), np.minimum(frames + 1, frames[-1])
        poses = scene.world_from_camera
        lapse = np.maximum(seconds[after] - seconds[before], np.finfo(float).tiny)[:, None]
        self._rates = SE3.local(poses[before], poses[after]) / lapse
        self.velocities = (SE3.translation(poses[after]) - SE3.translation(poses[before])) / lapse
        """(T, 3) of the camera in the world, m/s."""
        self._vignette = _vignette(camera, imaging.vignetting)
        self._probe = camera.unproject(_probes(camera))
        self._seeds = rng.integers(2**63, size=len(frames))

    def images(self, frame: int, baseline_m: float | None = None) -> list[np.ndarray]:
        """Pictures (H, W) uint8 of a frame: one, or two with a second camera so far to the right."""
        rng = np.random.default_rng(self._seeds[frame])
        poses = self._poses(frame, rng)
        views = [poses]
        if baseline_m is not None:
            views.append(SE3.compose(poses, SE3.exp([0.0, 0.0, 0.0, baseline_m, 0.0, 0.0])))
        return [self._develop(self._renderer.image(view), self._gain[frame], rng) for view in views]

    def _poses(self, frame: int, rng: np.random.Generator) -> np.ndarray:
        """(K, 7) poses while the shutter is open: K is a square, and as great as the motion in pixels."""
        middle = self._scene.world_from_camera[frame]
        half = 0.5 * self._imaging.blur_s * self._rates[frame]
        travel = self._travel(middle, half)
        if travel == 0.0:
            return middle[None]
        side = int(np.clip(np.ceil(np.sqrt(travel)), self._imaging.grid, max(self._imaging.grid, MOST_RAYS)))
        # The renderer deals the rays of a pixel out in order of their columns, which must not follow the time.
        moment = (rng.permutation(side * side) + 0.5) / (side * side)
        return SE3.retract(middle, (2.0 * moment - 1.0)[:, None] * half)

    def _travel(self, middle: np.ndarray, half: np.ndarray) -> float:
        """Greatest distance [px] that what is seen moves from middle ⊖ half to middle ⊕ half."""
        if not half.any():
            return 0.0
        depth, row = cast(self._scene.rectangles, middle, self._probe)
        ray = np.concatenate([self._probe, np.ones((len(self._probe), 1))], axis=1)[row >= 0]
        points = SE3.transform(middle, depth[row >= 0, None] * ray)
        local = SE3.inverse_transform(SE3.retract(middle, np.stack([-half, half])[:, None]), points)
        seen = self._camera.visible(local).all(axis=0)
        start, end = self._camera.project(local[:, seen])
        return float(np.linalg.norm(end - start, axis=-1).max(initial=0.0))

    def _develop(self, light: np.ndarray, gain: float, rng: np.random.Generator) -> np.ndarray:
        """Grey levels (H, W) uint8 of what the sensor receives."""
        import cv2

        lens = self._imaging.lens_px
        focused = np.asarray(cv2.GaussianBlur(light, (0, 0), lens)) if lens > 0.0 else light
        signal = focused * (gain * self._vignette)
        if self._imaging.noise_std > 0.0:
            signal += self._imaging.noise_std * rng.standard_normal(signal.shape, dtype=np.float32)
        return np.clip(np.rint(signal), 0, 255).astype(np.uint8)


def _vignette(camera: Pinhole, fraction: float) -> np.ndarray:
    """(H, W) float32 factors that fall with the square of the distance from the principal point."""
    rows, columns = np.indices((camera.height, camera.width))
    square = (columns - camera.cx) ** 2 + (rows - camera.cy) ** 2
    return (1.0 - fraction * square / square.max()).astype(np.float32)


def _probes(camera: Pinhole) -> np.ndarray:
    """(K, 2) pixels spread over the image."""
    rows = (np.arange(PROBES[0]) + 0.5) / PROBES[0] * camera.height - 0.5
    columns = (np.arange(PROBES[1]) + 0.5) / PROBES[1] * camera.width - 0.5
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
