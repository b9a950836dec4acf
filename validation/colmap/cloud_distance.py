"""Distances from landmarks to a cloud of points in the same world, told so that single wrong points do not matter.

Two detectors seldom choose the same spots, so the nearest point is about as far as the cloud is sparse. The distance
from the plane of the nearest points does not depend on that where the surface is smooth.
"""

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy.spatial import cKDTree

from rbpf.errors import InputError
from rbpf.lie import Array

NEIGHBOURS = 6
"""Points of the cloud that a plane is laid through."""

LEAST_POINTS = 3
"""Of a cloud, for a plane."""


@final
@dataclass(frozen=True, eq=False)
class CloudDistance:
    """Distances from M landmarks to a cloud.

    Attributes:
        nearest_m: (M,) to the nearest point.
        surface_m: (M,) to the plane that fits the nearest points best.
        sigmas: (M,) the latter in the landmark's standard deviation across the plane; NaN without covariances.
        spacing_m: median distance from the nearest points to their own nearest neighbour.
    """

    nearest_m: Array
    surface_m: Array
    sigmas: Array
    spacing_m: float

    def as_dict(self) -> dict[str, Any]:
        """Quantiles for JSON."""
        figures = {"landmarks": len(self.nearest_m), "cloud_spacing_median_m": self.spacing_m}
        for name in ("nearest", "surface"):
            median, p90 = np.quantile(getattr(self, f"{name}_m"), [0.5, 0.9]).tolist()
            figures |= {f"{name}_median_m": median, f"{name}_p90_m": p90}
        known = self.sigmas[np.isfinite(self.sigmas)]
        if known.size:
            figures["surface_median_sigmas"] = float(np.median(known))
            figures["share_within_3_sigmas"] = float((known < 3.0).mean())
        return figures


def cloud_distance(cloud: Array, landmarks: Array, cov_landmarks: Array | None = None) -> CloudDistance:
    """Distances of landmarks to a cloud.

    Args:
        cloud: (P, 3), P >= 3.
        landmarks: (M, 3), M >= 1.
        cov_landmarks: (M, 3, 3).

    Raises:
        InputError: the cloud or the map is too small.
    """
    if len(cloud) < LEAST_POINTS or not len(landmarks):
        found = f"{len(cloud)} and {len(landmarks)}"
        raise InputError(f"Expected {LEAST_POINTS} or more points of a cloud and a landmark, found {found}.")
    tree = cKDTree(cloud)
    distances, rows = tree.query(landmarks, k=min(NEIGHBOURS, len(cloud)))
    spacing = tree.query(cloud[rows[:, 0]], k=2)[0][:, 1]
    around = cloud[rows]
    middle = around.mean(axis=1)
    normal = np.linalg.svd(around - middle[:, None])[2][:, 2]
    surface = np.abs(np.einsum("ki,ki->k", landmarks - middle, normal))
    sigmas = np.full(len(landmarks), np.nan)
    if cov_landmarks is not None:
        sigmas = surface / np.sqrt(np.einsum("ki,kij,kj->k", normal, cov_landmarks, normal))
    return CloudDistance(distances[:, 0], surface, sigmas, float(np.median(spacing)))
