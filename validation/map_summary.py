"""The map of a finished filter as one Gaussian per landmark, within + between particles."""

from dataclasses import dataclass

import numpy as np

from rbpf import gaussian
from rbpf.filter import Filter
from rbpf.validation.matching import match_points


@dataclass(frozen=True)
class MapSummary:
    """Landmarks of a run.

    Attributes:
        ids: (M,) names: the log's where the association is known, else the map's.
        mean: (M, D) positions in the world, metres.
        cov: (M, D, D).
    """

    ids: np.ndarray
    mean: np.ndarray
    cov: np.ndarray

    def named(self, truth: dict[int, np.ndarray], anonymous: bool) -> dict[int, np.ndarray]:
        """Positions by the truth's names; anonymous landmarks get the name of the nearest true one, one to one."""
        if not anonymous:
            return dict(zip(self.ids.tolist(), self.mean, strict=True))
        return match_points(self.mean, truth)


def summarise_map(filter_: Filter) -> MapSummary:
    """Mixture moments of every landmark that exists in most of the weight."""
    belief = filter_.belief()
    landmark_map, weights = belief.map, belief.weights
    names, means, covs = [], [], []
    for landmark_id in landmark_map.ids:
        held = np.ones(weights.size)
        if landmark_map.evidence:
            held = landmark_map.log_odds(np.array([landmark_id]))[:, 0] > 0
        share = (weights * held).sum()
        if share <= 0.5:
            continue
        records = landmark_map.read(np.array([landmark_id]))
        own = weights * held / share
        mean = (own[:, None] * records.mean[:, 0]).sum(axis=0)
        spread = records.mean[:, 0] - mean
        cov = (own[:, None, None] * (records.cov[:, 0] + spread[:, :, None] * spread[:, None, :])).sum(axis=0)
        names.append(landmark_map.catalogue.get(int(landmark_id), int(landmark_id)))
        means.append(mean)
        covs.append(gaussian.symmetrise(cov))
    dim = landmark_map.layouts[0].landmark.dim
    return MapSummary(
        np.array(names, dtype=np.int64), np.array(means).reshape(-1, dim), np.array(covs).reshape(-1, dim, dim)
    )
