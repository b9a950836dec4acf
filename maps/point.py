"""Landmarks that are points in the plane or in space: Gaussian, in the frame of an anchor, or on a curve (a mixture)."""

from typing import final

import numpy as np

from rbpf.core.likelihoods import squared_mahalanobis
from rbpf.core.models import Landmark, Records, RigidSpace
from rbpf.errors import InputError
from rbpf.lie import SE2Group, SE3Group

#: Distance from the heaviest component of a mixture, in its standard deviations, within which others count as the same mode;
#: and the weight of that mode at which the mixture can become a single Gaussian.
REACH, DOMINANT = 3.0, 0.99


@final
class Point(Landmark):
    """A world point (x, y[, z]) in metres, E06 (6), in 2 or 3 dimensions."""

    def __init__(self, dim: int = 3) -> None:
        self.dim = dim

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        return np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)

    def point(self, mean: np.ndarray, const: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        return mean, np.broadcast_to(np.eye(self.dim), (*mean.shape, self.dim))

    def seen_from(self, space: RigidSpace, pose: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R(pose)ᵀ (p − t)."""
        return space.inverse_transform(pose, mean), np.swapaxes(space.rotation(pose), -1, -2)


@final
class AnchoredPoint(Landmark):
    """A point in the frame of an anchor in SE2 or SE3, which is the record's constant: world_from_anchor (E,)."""

    anchored = True

    def __init__(self, space: SE2Group | SE3Group) -> None:
        self.space = space
        self.dim = 2 if isinstance(space, SE2Group) else 3
        self.constants = space.size

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        assert const is not None
        world = self.space.transform(const, mean)
        return np.concatenate([world, np.ones((*world.shape[:-1], 1))], axis=-1)


@final
class MixturePoint(Landmark):
    """A world point as C ≥ 2 weighted Gaussians in 2 or 3 dimensions, such as the ring of a range-only beacon.

    It can become a single one once the components close to the heaviest one dominate: Mathematics (mixture).
    """

    def __init__(self, components: int, dim: int = 2) -> None:
        self.components = components
        self.dim = dim

    def homogeneous(self, mean: np.ndarray, const: np.ndarray | None = None) -> np.ndarray:
        return np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)

    def ready(self, records: Records) -> np.ndarray:
        assert records.log_weights is not None
        heaviest = records.log_weights.argmax(axis=-1)[..., None, None]
        mean = np.take_along_axis(records.mean, heaviest, axis=2)
        cov = np.take_along_axis(records.cov, heaviest[..., None], axis=2)
        near = squared_mahalanobis(records.mean - mean, np.broadcast_to(cov, records.cov.shape)) <= REACH**2
        return (np.exp(records.log_weights) * near).sum(axis=-1) >= DOMINANT


def ring_components(radius: float, std_radius: float, dim: int = 2) -> int:
    """Least number of Gaussians for a circle, or in 3 dimensions a sphere; radius and standard deviation in metres.

    Each is flat: one standard deviation along it the curve may be off by at most half the standard deviation across it.
    """
    bend = std_radius / radius
    if dim == 3:
        return max(6, int(np.ceil(4.0 / bend)))
    return max(4, int(np.ceil(np.pi / np.arcsin(min(1.0, np.sqrt(bend))))))


def ring(centre: np.ndarray, radius: np.ndarray, std_radius: float, components: int | None = None) -> Records:
    """Gaussians along a circle, or over a sphere, for a range-only measurement of a beacon; neighbours overlap at one σ.

    Centres (N, D) of the sensor, D = 2 or 3, and ranges (K,) with standard deviation `std_radius`, in metres, give records
    with means (N, K, C, D), covariances (N, K, C, D, D) and equal weights; C is that of the landmarks' `MixturePoint`, by
    default that of the longest range. Raises InputError: the range needs more components than C.
    """
    (n, dim), k, longest = centre.shape, radius.size, float(radius.max(initial=std_radius))
    needed = ring_components(longest, std_radius, dim)
    components = components or needed
    if components < needed:
        raise InputError(
            f"a range of {longest:.3g} ± {std_radius:.3g} m needs {needed} components, not {components}: "
            f"see ring_components(longest range, deviation, {dim})"
        )
    if dim == 2:
        angle = 2 * np.pi * np.arange(components) / components
        along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        half_step = radius * np.sin(np.pi / components)
        turned = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        across = turned[:, :, None] * turned[:, None, :]
    else:
        # A Fibonacci lattice: equal areas, each that of a disc of the radius 2 r / √C.
        height = 1.0 - (2.0 * np.arange(components) + 1.0) / components
        angle, flat = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(components), np.sqrt(1.0 - height**2)
        along = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=-1)
        half_step = 2.0 * radius / np.sqrt(components)
        across = np.eye(3) - along[:, :, None] * along[:, None, :]
    mean = centre[:, None, None, :] + radius[None, :, None, None] * along
    cov = std_radius**2 * along[:, :, None] * along[:, None, :] + np.multiply.outer(half_step**2, across)
    weights = np.full((n, k, components), -np.log(components))
    return Records(mean, np.broadcast_to(cov, (n, k, components, dim, dim)).copy(), None, weights)
