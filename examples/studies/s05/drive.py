"""The robot's drive: rendered once, its features measured once, and filtered repeatedly."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from examples.studies.feature_cache import CachedSequence, cache_features
from examples.studies.lab import LabDrive, TexturedLab
from examples.studies.wheel_odometry import write_wheel_odometry
from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import open_stereo
from rbpf.systems.stereo.config import OdometryConfig, StereoConfig, TriggerConfig
from rbpf.validation.simulation.images import Imaging, simulate_images

FOCAL, BASELINE_M = 0.78125, 0.12
"""Focal length as a fraction of the image's width: that of `examples/studies/lab.py`."""

NOISE_STD = 5.0
"""Sensor noise, grey levels. With the simulator's other defaults the inliers between pairs are as many as in a real room."""


@dataclass(frozen=True)
class Setting:
    """Settings of rendering and filtering.

    Attributes:
        out: folder for images, features, table and plots.
        frames: number of pairs, from the start of the tour.
        every: every n-th frame is a pair.
        width: of the images, px.
        texel_m: side of a texel of the walls.
        particles: number of particles.
        dof: degrees of freedom; the paper's are 3.
        trigger_m: distance between updates.
        seed: of the images and of the filter.
    """

    out: Path
    frames: int = 4000
    every: int = 1
    width: int = 640
    texel_m: float = 0.003
    particles: int = 400
    dof: int = 3
    trigger_m: float = 0.015
    seed: int = 0

    @property
    def images(self) -> Path:
        """Folder of the rendered sequence."""
        return self.out / "lab"

    def config(self) -> StereoConfig:
        """Settings of the filter: the paper's, with its three degrees of freedom."""
        if self.dof not in (3, 6):
            raise InputError(f"dof must be 3 or 6, got {self.dof}")
        trigger = TriggerConfig(self.trigger_m, self.trigger_m)
        odometry = OdometryConfig(independent=True)
        base, dof = StereoConfig.s05(), 3 if self.dof == 3 else 6
        return replace(base, particles=self.particles, seed=self.seed, dof=dof, trigger=trigger, odometry=odometry)


def measured_drive(
    setting: Setting, told: Callable[[str, int, int], None] = lambda what, done, total: None
) -> CachedSequence:
    """The features of the drive; existing images and features are reused.

    Args:
        setting: what is rendered.
        told: called with a description, the number of pairs done, and the total.

    Raises:
        InputError: existing files are of another drive, or shorter.
    """
    if not setting.images.exists():
        width = setting.width
        size = FOCAL * width, FOCAL * width, 0.5 * width - 0.5, 0.375 * width - 0.5
        rig = RectifiedStereo(Pinhole(width, 3 * width // 4, *size), BASELINE_M)
        world = TexturedLab(LabDrive(frames=setting.frames, every=setting.every), texel_m=setting.texel_m)
        imaging = Imaging(noise_std=NOISE_STD, known=0)
        simulate_images(
            world, imaging, rig, setting.images, setting.seed, lambda done, total: told("rendered", done, total)
        )
        write_wheel_odometry(setting.images, world.wheels(setting.seed))
    sequence = open_stereo(setting.images)
    if len(sequence) < setting.frames:
        have = f"{setting.images} has {len(sequence)} pairs, {setting.frames} are asked for"
        raise InputError(f"{have}: delete it, or take another --out")
    features = setting.out / "features"
    whole = cache_features(sequence, setting.config(), features, lambda done, total: told("measured", done, total))
    return whole.first(setting.frames)
