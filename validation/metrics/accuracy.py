"""Accuracy metrics: absolute and relative error of trajectories, error of landmarks.

The definitions are those of J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS
2012.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.trajectory import Alignment, Similarity, Trajectory, fit


@final
@dataclass(frozen=True)
class AbsoluteError:
    """Distances between estimated and true positions."""

    keys: NDArray[np.int64]  #: (N,) the reference stamp of each pose, or the name of each landmark.
    distances: Array  #: (N,) [m].
    alignment: Similarity  #: the alignment applied to the estimate.

    @property
    def rmse(self) -> float:
        """Root of the mean square distance [m]."""
        return _rms(self.distances)

    @property
    def mean(self) -> float:
        """Mean distance [m]."""
        return float(self.distances.mean())

    @property
    def median(self) -> float:
        """Median distance [m]."""
        return float(np.median(self.distances))

    @property
    def max(self) -> float:
        """Largest distance [m]."""
        return float(self.distances.max())


@final
@dataclass(frozen=True)
class RelativeError:
    """Differences between S estimated and true motions."""

    translations: Array  #: (S,) [m].
    rotations_deg: Array  #: (S,) angles in [0, 180].

    @classmethod
    def of(cls, true: Array, estimated: Array) -> Self:
        """From motions (S, 7), each a relative pose."""
        error = SE3.between(true, estimated)
        turned = np.linalg.norm(SE3.log(error)[:, :3], axis=-1)
        return cls(np.linalg.norm(SE3.translation(error), axis=-1), np.degrees(turned))

    @property
    def translation_rmse(self) -> float:
        """Root of the mean square translation [m]."""
        return _rms(self.translations)

    @property
    def rotation_rmse_deg(self) -> float:
        """Root of the mean square angle [deg]."""
        return _rms(self.rotations_deg)


def ate(estimate: Trajectory, reference: Trajectory, alignment: Alignment | Similarity = "none") -> AbsoluteError:
    """Absolute trajectory error, the distance of each of T positions from the true one of the same row (see `associate`).

    An alignment is fitted to all positions before, or a similarity applied.

    Raises InputError: the lengths differ or are 0, or the alignment is unknown.
    """
    _require_pairs(estimate, reference)
    applied = fit(alignment, estimate.positions, reference.positions)
    distances = np.linalg.norm(applied.transform(estimate.positions) - reference.positions, axis=-1)
    return AbsoluteError(reference.stamps_ns, distances, applied)


def rpe(estimate: Trajectory, reference: Trajectory, alignment: Alignment | Similarity = "none") -> RelativeError:
    """Relative pose error, the difference of the motions from each of T poses to the next, of two poses or more.

    Only the scale of an alignment has an effect.

    Raises InputError: the lengths differ or are below 2, or the alignment is unknown.
    """
    _require_pairs(estimate, reference)
    if len(estimate) < 2:
        raise InputError("Expected a trajectory of two poses or more, found one: it has no motion.")
    moved = estimate.transformed(fit(alignment, estimate.positions, reference.positions))
    motions = (SE3.between(p.world_from_body[:-1], p.world_from_body[1:]) for p in (reference, moved))
    return RelativeError.of(*motions)


def landmark_errors(
    estimate: Mapping[int, Array], truth: Mapping[int, Array], alignment: Alignment | Similarity = "none"
) -> AbsoluteError:
    """Distances of the landmarks (D,) [m] that two maps have by name, in order of the names.

    A similarity is fitted to the common landmarks before, or a given one applied.

    Raises InputError: no landmark is in both maps, or the alignment is unknown.
    """
    names = sorted(estimate.keys() & truth.keys())
    if not names:
        raise InputError(f"None of the {len(estimate)} estimated landmarks is among the {len(truth)} true ones.")
    found, true = (np.array([points[name] for name in names], dtype=float) for points in (estimate, truth))
    applied = fit(alignment, found, true)
    return AbsoluteError(np.array(names), np.linalg.norm(applied.transform(found) - true, axis=-1), applied)


def _require_pairs(estimate: Trajectory, reference: Trajectory) -> None:
    if len(estimate) != len(reference) or not len(estimate):
        counts = f"{len(estimate)} and {len(reference)}"
        raise InputError(f"Expected as many estimated as true poses, found {counts}; pair them with associate.")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))
