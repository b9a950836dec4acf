"""Sensors of landmarks: with known association, or associated by maximum likelihood in each particle."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, final

import numpy as np

from rbpf.core.likelihoods import ExistenceModel, Gates, associate
from rbpf.core.models import (
    NEW,
    Belief,
    Landmark,
    Likelihood,
    NewLandmarks,
    ObservationModel,
    Observations,
    Part,
    Sensor,
)
from rbpf.errors import InputError


class LandmarkFrame(Protocol):
    """What these sensors require of a frame: `landmarks` (K,) numbers, `z` (K, p), `cov_z` (K, p, p)."""

    @property
    def landmarks(self) -> np.ndarray: ...
    @property
    def z(self) -> np.ndarray: ...
    @property
    def cov_z(self) -> np.ndarray: ...


@final
@dataclass(eq=False)
class NamedLandmarkSensor(Sensor):
    """Known association: each observation carries the landmark's number, which is its id in the map.

    A number that is not in the map initialises a landmark. The caller has to map textual names to numbers. The default
    likelihood of an innovation is Gaussian. With one that `rejects` outliers, a landmark whose second observation
    contradicts the first is re-initialised by it: either observation may be the outlier.
    """

    model: ObservationModel
    landmark: Landmark
    likelihood: Likelihood | None = None
    part: Part = Part.LANDMARK
    #: landmarks that were observed once, by a likelihood that rejects outliers.
    observed_once: set[int] = field(default_factory=set, init=False)
    _contradicted: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64), init=False)

    def observe(self, frame: LandmarkFrame, belief: Belief) -> Sequence[Observations]:
        """The observations of landmarks in the map."""
        if frame.landmarks.size and frame.landmarks.dtype.kind not in "iu":
            first = frame.landmarks[0]
            raise InputError(f"landmarks must be whole numbers from 0 up, got {first!r}: number their names")
        known = belief.map.holds(frame.landmarks)
        self._contradicted = self._contradicted[:0]
        if not known.any():
            return []
        ids = frame.landmarks[known]
        second = np.flatnonzero(known & np.isin(frame.landmarks, list(self.observed_once)))
        if second.size:
            predicted, cov = belief.project(self.model, frame.landmarks[second])
            nu = self.model.residual(frame.z[second], predicted)
            assert self.likelihood is not None
            agrees = self.likelihood.inlier(nu, cov + frame.cov_z[second])
            self._contradicted = np.unique(frame.landmarks[second[~agrees]])
        return [Observations(frame.z[known], frame.cov_z[known], self.model, self.likelihood, ids)]

    def new_landmarks(
        self, frame: LandmarkFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """The first observation of each new landmark; a second one in the same frame is ignored."""
        self.observed_once.difference_update(frame.landmarks.tolist())  # not in `observe`: the step may be refused
        if self._contradicted.size:
            belief.map.remove(self._contradicted)
        first = np.zeros(frame.landmarks.size, dtype=bool)
        first[np.unique(frame.landmarks, return_index=True)[1]] = True
        new = first & ~belief.map.holds(frame.landmarks)
        if not new.any():
            return []
        ids = frame.landmarks[new]
        if self.likelihood is not None and self.likelihood.rejects:
            self.observed_once |= set(ids.tolist())
        return [NewLandmarks(frame.z[new], frame.cov_z[new], self.model, self.landmark, ids=ids)]


@final
@dataclass(eq=False)
class AnonymousLandmarkSensor(Sensor):
    """Unknown association: maximum likelihood per particle with mutual exclusion; spurious landmarks are deleted.

    The map must keep evidence (`LandmarkMap(space, evidence=True)`); the model's `visible` tells which landmarks should have
    been observed. The default likelihood of an innovation is Gaussian.
    """

    model: ObservationModel
    landmark: Landmark
    gates: Gates
    existence: ExistenceModel = field(default_factory=ExistenceModel)
    likelihood: Likelihood | None = None
    part: Part = Part.LANDMARK

    def observe(self, frame: LandmarkFrame, belief: Belief) -> Sequence[Observations]:
        """All measurements, with the association of each particle."""
        if not frame.z.shape[0]:
            return []
        ids = belief.map.ids
        if ids.size:
            present = ~np.isneginf(belief.map.log_odds(ids))
            nu, cov = belief.predictions(self.model, frame.z, frame.cov_z, ids)
            chosen = associate(nu, cov, present, self.gates)
            chosen = np.where(chosen >= 0, ids[np.maximum(chosen, 0)], chosen)
        else:
            chosen = np.full((belief.log_weights.size, frame.z.shape[0]), NEW)
        gates = self.gates
        return [
            Observations(frame.z, frame.cov_z, self.model, self.likelihood, chosen, gates.log_new, gates.log_clutter)
        ]

    def new_landmarks(
        self, frame: LandmarkFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """Updates the evidence of landmarks expected in view; initialises those that any particle takes as new."""
        chosen = np.zeros((belief.log_weights.size, 0), dtype=np.int64)
        if observed and observed[0].ids is not None:
            chosen = observed[0].ids
        ids = belief.map.ids
        if ids.size:
            records = belief.read(ids)
            expected = self.model.visible(belief.state[:, None, :], records.mean, records.const)
            seen = (chosen[:, :, None] == ids).any(axis=1)
            belief.map.set_log_odds(ids, self.existence.updated(belief.map.log_odds(ids), seen, expected))
        new = (chosen == NEW).any(axis=0)
        if not new.any():
            return []
        return [NewLandmarks(frame.z[new], frame.cov_z[new], self.model, self.landmark, chosen[:, new] == NEW)]
