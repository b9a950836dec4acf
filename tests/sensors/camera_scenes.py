"""Cameras among points and rays, and the compiled twins called by hand."""

from dataclasses import dataclass

import numpy as np

from rbpf.core.models import ObservationModel
from rbpf.kernels.landmarks import call_kernel
from rbpf.kernels.signature import BLOCK
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole

PLAIN = Pinhole(640, 480, 400.0, 410.0, 319.5, 239.5)
DISTORTED = Pinhole(640, 480, 400.0, 410.0, 319.5, 239.5, (-0.28, 0.07, 2e-4, -3e-4, 0.01))
FISHEYE = Pinhole(640, 480, 400.0, 410.0, 319.5, 239.5, (-0.03, 0.02, -0.012, 0.002), "equidistant")
CAMERAS = {"plain": PLAIN, "distorted": DISTORTED, "fisheye": FISHEYE}


@dataclass(frozen=True)
class Rays:
    """N particles that see K rays each, from a little beside where these were first seen.

    Attributes:
        state: (N, 7) world_from_camera.
        mean: (N, K, 3) u, v, q.
        const: (N, K, 7) world_from_anchor.
    """

    state: np.ndarray
    mean: np.ndarray
    const: np.ndarray

    @classmethod
    def random(cls, n: int = 4, k: int = 5, seed: int = 0, moved: float = 0.2) -> "Rays":
        rng = np.random.default_rng(seed)
        const = SE3.exp(rng.normal(size=(1, 1, 6)) + rng.normal(scale=0.05, size=(n, k, 6)))
        state = SE3.retract(const[:, 0], rng.normal(scale=moved, size=(n, 6)))
        mean = rng.uniform([-0.4, -0.3, 0.2], [0.4, 0.3, 1.0], size=(n, k, 3))
        return cls(state, mean, const)

    @property
    def points(self) -> np.ndarray:
        """(N, K, 3) where they end, in the world."""
        ray = np.concatenate([self.mean[..., :2], np.ones((*self.mean.shape[:-1], 1))], axis=-1)
        return SE3.transform(self.const, ray / self.mean[..., 2:])


def with_velocity(state: np.ndarray) -> np.ndarray:
    """States (N, 13): a velocity behind the pose."""
    return np.concatenate([state, np.random.default_rng(9).normal(size=(*state.shape[:-1], 6))], axis=-1)


def compiled(
    model: ObservationModel, z: np.ndarray, state: np.ndarray, mean: np.ndarray, const: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The fused kernel on n ≤ BLOCK lanes: ν (n, p), and its Jacobians (n, p, 6) and (n, p, D)."""
    fused = model.kernel()
    assert fused is not None
    n, p, size = state.shape[0], z.shape[0], mean.shape[1]
    nu, by_state = np.full((p, BLOCK), np.nan), np.full((p, 6, BLOCK), np.nan)
    by_landmark = np.full((p, size, BLOCK), np.nan)

    def lanes(part: np.ndarray | None) -> np.ndarray:
        if part is None:
            return np.zeros((0, BLOCK))
        return np.ascontiguousarray(part[np.minimum(np.arange(BLOCK), n - 1)].T)

    inputs = (lanes(state), lanes(mean), lanes(const))
    call_kernel(fused.function.address, *inputs, z, fused.params, n, nu, by_state, by_landmark)
    parts = [np.moveaxis(part[..., :n], -1, 0) for part in (nu, by_state, by_landmark)]
    return parts[0], parts[1], parts[2]
