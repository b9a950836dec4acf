"""The map of a finished filter as one Gaussian per landmark, within + between particles."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rbpf import gaussian
from rbpf.core.anchoring import Anchored
from rbpf.core.archive import checked
from rbpf.core.checkpoint import fitting
from rbpf.core.filter import Filter
from rbpf.core.models import Records
from rbpf.errors import InputError
from rbpf.sensors.range_bearing import RelativePosition


@dataclass(frozen=True)
class MapEstimate:
    """Landmarks of a run.

    Attributes:
        ids: (M,) names: the log's where the association is known, else the map's.
        mean: (M, D) positions in the world, metres.
        cov: (M, D, D).
    """

    ids: np.ndarray
    mean: np.ndarray
    cov: np.ndarray

    def named(self) -> dict[int, np.ndarray]:
        """Positions by name."""
        return dict(zip(self.ids.tolist(), self.mean, strict=True))


def map_of(path: Path, arrays: dict[str, np.ndarray]) -> MapEstimate:
    """The landmarks of a map.npz that are points; those whose depth is not known are left out.

    Args:
        path: of the file, for messages.
        arrays: what it holds.

    Raises:
        InputError: an array is missing, or is not what it should be.
    """
    with fitting(path):
        ids = checked(arrays, "id", (None,), "iu")
        mean = checked(arrays, "mean", (ids.size, None), "f")
        if mean.shape[1] not in (2, 3):
            raise InputError(f"the array mean must have points in the plane or in space, got {mean.shape}")
        cov = checked(arrays, "cov", (ids.size, mean.shape[1], mean.shape[1]), "f")
        known = np.ones(ids.size, dtype=bool)
        if "ray" in arrays:
            known = checked(arrays, "ray", (ids.size,), "iub") == 0
    return MapEstimate(ids[known], mean[known], cov[known])


def estimate_map(filter_: Filter, anchored: Anchored | None = None) -> MapEstimate:
    """Mixture moments of every landmark that exists in most of the weight.

    Args:
        filter_: holds a map of point landmarks.
        anchored: the start in each particle's world; the map is then told relative to it.
    """
    belief = filter_.belief()
    landmark_map, weights = belief.map, belief.weights
    names, means, covs = [], [], []
    for landmark_id in landmark_map.ids:
        held = np.ones(weights.size)
        if landmark_map.evidence:
            held = landmark_map.log_odds(np.array([landmark_id]))[:, 0] > 0
        fraction = (weights * held).sum()
        if fraction <= 0.5:
            continue
        records = landmark_map.read(np.array([landmark_id]))
        points, within = records.mean[:, 0], records.cov[:, 0]
        if anchored is not None:
            points, within = relative_points(filter_.space, anchored, records)
        own = weights * held / fraction
        mean, cov = mixture_moments(own, points, within)
        names.append(landmark_map.catalogue.get(int(landmark_id), int(landmark_id)))
        means.append(mean)
        covs.append(cov)
    dim = landmark_map.layouts[0].landmark.dim
    return MapEstimate(
        np.array(names, dtype=np.int64),
        np.array(means).reshape(-1, dim),
        np.array(covs).reshape(-1, dim, dim),
    )


def mixture_moments(
    weights: np.ndarray, points: np.ndarray, within: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (D,) and covariance (D, D) of Gaussians (N, D), (N, D, D) of weights (N,): within + between."""
    mean = (weights[:, None] * points).sum(axis=0)
    spread = points - mean
    between = spread[:, :, None] * spread[:, None, :]
    return mean, gaussian.symmetrise((weights[:, None, None] * (within + between)).sum(axis=0))


def relative_points(space: Any, anchored: Anchored, records: Records) -> tuple[np.ndarray, np.ndarray]:
    """Landmark positions (N, D) relative to the start, and their covariance with the start's."""
    model = RelativePosition(space)
    start = anchored.mean[:, None]
    jac = model.jacobians(start, records.mean)
    assert jac.state is not None and jac.landmark is not None
    moved = jac.state[:, 0] @ anchored.factor
    turned = jac.landmark[:, 0]
    cov = turned @ records.cov[:, 0] @ np.swapaxes(turned, -1, -2) + moved @ np.swapaxes(moved, -1, -2)
    return model.predict(start, records.mean)[:, 0], cov
