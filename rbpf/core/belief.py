"""What a sensor may know before it measures: the predicted mixture, and the map behind it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rbpf import gaussian
from rbpf.core.conditional import Marginals
from rbpf.core.models import ObservationModel, Part, Records
from rbpf.core.numeric import linearise
from rbpf.core.proposals import Prior
from rbpf.errors import InputError


@dataclass(frozen=True)
class Belief:
    """A weighted mixture of Gaussians over the state, each with its own marginalised part.

    Attributes:
        log_weights: (N,) normalised.
        prior: law of each particle's increment; after the update its factor is zero.
        marginals: the parts that are marginalised.
    """

    log_weights: np.ndarray
    prior: Prior
    marginals: Marginals

    @cached_property
    def state(self) -> np.ndarray:
        """(N, E) predicted states, or sampled ones after the update."""
        return self.prior.predicted()

    @cached_property
    def weights(self) -> np.ndarray:
        """(N,) summing to one."""
        return np.exp(self.log_weights)

    @cached_property
    def mode(self) -> int:
        """The particle of highest weight."""
        return int(np.argmax(self.log_weights))

    @property
    def map(self) -> Any:
        """The landmark map.

        Raises:
            InputError: the filter holds none.
        """
        if Part.LANDMARK not in self.marginals.parts:
            raise InputError("this sensor needs a landmark map: give the filter a LandmarkMap")
        return self.marginals.parts[Part.LANDMARK]

    @property
    def catalogue(self) -> dict[int, Any]:
        """Facts about landmarks that do not differ between particles: names, patches, descriptors, counters."""
        return self.map.catalogue

    def read(self, ids: Sequence[int] | np.ndarray, particles: np.ndarray | slice = slice(None)) -> Records:
        """Estimates (N, K, …) of landmarks of one parametrisation, in all particles or in the rows named."""
        return self.map.read(np.asarray(ids, dtype=np.int64), particles)

    def read_mode(self, ids: Sequence[int] | np.ndarray) -> Records:
        """Estimates (1, K, …) in the particle of highest weight alone."""
        return self.read(ids, slice(self.mode, self.mode + 1))

    def innovations(
        self, model: ObservationModel, z: np.ndarray, ids: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of K measurements in the particle of highest weight: ν (K, p), ∂z/∂state (K, p, d) and J P Jᵀ (K, p, p)."""
        nu, jac, records = self.map.innovations(model, z, ids, self.state[self.mode], self.mode)
        return nu, jac.state, jac.landmark @ records.cov[0] @ np.swapaxes(jac.landmark, -1, -2)

    def predictions(
        self, model: ObservationModel, z: np.ndarray, cov: np.ndarray, ids: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Innovations ν (N, K, M, p) of K measurements against M landmarks, and S + H Q Hᵀ (N, K, M, p, p)."""
        records = self.read(ids)
        state = self.state[:, None, :]
        space = self.prior.space
        anchor = model.predict(state, records.mean, records.const)
        nu = model.residual(z[:, None, :], anchor[:, None])
        _, jac = linearise(model, space, anchor, state, records.mean, records.const)
        assert jac.state is not None and jac.landmark is not None
        within = self._covariance(jac.state, jac.landmark, records.cov)
        return nu, within[:, None] + cov[:, None]

    def project(self, model: ObservationModel, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where landmarks will be measured: mean (K, p) and covariance (K, p, p) under all particles (E06 §4.1).

        The covariance is within + between particles, H Q Hᵀ included, without the measurement's own noise.
        """
        if self.map.is_compiled(model, ids):
            nothing = np.zeros((ids.size, model.dim))
            anchor = -self.map.innovations(model, nothing, ids, self.state[self.mode], self.mode)[0]
            mean, cov = self.map.project(model, ids, anchor, self.weights, self.prior)
            return anchor + mean, cov
        records, state = self.read(ids), self.state[:, None, :]
        predicted = model.predict(state, records.mean, records.const)
        mode = predicted[self.mode]
        offset, jac = linearise(model, self.prior.space, predicted, state, records.mean, records.const)
        assert jac.state is not None and jac.landmark is not None
        offset = model.residual(predicted, mode)
        weights = self.weights[:, None, None]
        mean = (weights * offset).sum(axis=0)
        spread = offset - mean
        within = self._covariance(jac.state, jac.landmark, records.cov)
        between = spread[..., :, None] * spread[..., None, :]
        return mode + mean, (weights[..., None] * (within + between)).sum(axis=0)

    def _covariance(self, jac_state: np.ndarray, jac_map: np.ndarray, cov: np.ndarray) -> np.ndarray:
        moved = jac_state @ self.prior.spread(self.prior.mean)[:, None]
        total = jac_map @ cov @ np.swapaxes(jac_map, -1, -2) + moved @ np.swapaxes(moved, -1, -2)
        return gaussian.symmetrise(total)
