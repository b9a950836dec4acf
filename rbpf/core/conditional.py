"""Parts side by side: observations of the state alone, and the union of what is marginalised."""

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian
from rbpf.core.models import Conditional, LineariseAt, LogDensities, Observations, Part, Transition
from rbpf.core.numeric import linearise
from rbpf.core.proposals import Prior, Terms
from rbpf.core.reference import information
from rbpf.errors import InputError
from rbpf.lie import LieGroup

GAUSSIAN = Gaussian()


@final
class StateOnly(Conditional):
    """Observations that read the sampled state and nothing else, as a position fix."""

    supplies = Part.STATE

    def __init__(self, space: LieGroup) -> None:
        self.space = space

    def begin(self, n: int, lineage: Lineage) -> None:
        """Nothing is stored."""

    def terms(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Terms:
        """S = R."""
        total = Terms.zeros(state.shape[0], self.space.dim)
        for group in groups:
            nu, jacobians = linearise(group.model, self.space, group.z, state[:, None, :])
            assert jacobians.state is not None
            cov = np.broadcast_to(group.cov, (*nu.shape, nu.shape[-1]))
            total.add(information(nu, jacobians.state, cov, group.likelihood or GAUSSIAN, prior))
        return total

    def correct(
        self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]
    ) -> LogDensities:
        """Σ log p(z | x); there is nothing to update."""
        total = np.zeros(state.shape[0])
        for group in groups:
            nu = group.model.innovation(group.z, state[:, None, :])
            cov = np.broadcast_to(group.cov, (*nu.shape, nu.shape[-1]))
            total += (group.likelihood or GAUSSIAN).log_density(nu, cov).sum(axis=1)
        return LogDensities(total, np.zeros_like(total))

    def resample(self, ancestors: np.ndarray) -> None:
        """Nothing is stored."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Nothing is stored."""
        return {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Nothing is stored."""


@final
class Marginals(Conditional):
    """Several marginalised parts side by side; each observation goes to the part that it reads.

    A substate and a map together are exact only if no observation reads both.
    """

    supplies = Part.STATE

    def __init__(self, space: LieGroup, parts: Sequence[Conditional]) -> None:
        self.space = space
        self.parts = {part.supplies: part for part in (StateOnly(space), *parts)}
        if len(self.parts) != len(parts) + 1:
            raise InputError("the filter takes at most one landmark map and one Kalman substate")

    def begin(self, n: int, lineage: Lineage) -> None:
        """Begins every part."""
        for part in self.parts.values():
            part.begin(n, lineage)

    def predict(self, transition: Transition, space: LieGroup) -> Prior:
        """The substate's law where there is one."""
        driver = self.parts.get(Part.SUBSTATE, self.parts[Part.STATE])
        return driver.predict(transition, space)

    def terms(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Terms:
        """Sum over the parts that were observed."""
        total: Terms | None = None
        for supplies, routed in self._routed(groups).items():
            if routed:
                part = self.parts[supplies].terms(state, routed, prior)
                if total is None:
                    total = part
                else:
                    total.add(part)
        return Terms.zeros(state.shape[0], self.space.dim) if total is None else total

    def linearised(self, prior: Prior, groups: Sequence[Observations]) -> LineariseAt:
        """What the observations say about the state, to be linearised wherever a proposal asks."""
        return _LineariseGroups(self, prior, groups)

    def correct(
        self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]
    ) -> LogDensities:
        """Corrects every part."""
        total, late = np.zeros(state.shape[0]), np.zeros(state.shape[0])
        for supplies, routed in self._routed(groups).items():
            densities = self.parts[supplies].correct(state, increment, routed)
            total += densities.all
            late += densities.late
        return LogDensities(total, late)

    def resample(self, ancestors: np.ndarray) -> None:
        """Resamples every part."""
        for part in self.parts.values():
            part.resample(ancestors)

    def arrays(self) -> dict[str, np.ndarray]:
        """Of all parts."""
        return {name: array for part in self.parts.values() for name, array in part.arrays().items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Of all parts."""
        for part in self.parts.values():
            part.restore(arrays)

    def options(self) -> dict[str, Any]:
        """Of all parts."""
        return {name: value for part in self.parts.values() for name, value in part.options().items()}

    def _routed(self, groups: Sequence[Observations]) -> dict[Part, list[Observations]]:
        routed: dict[Part, list[Observations]] = {supplies: [] for supplies in self.parts}
        for group in groups:
            reads = group.model.reads - {Part.STATE}
            if len(reads) > 1:
                raise InputError(
                    f"{type(group.model).__name__} reads a landmark and the substate, which couples them: "
                    "sample that part of the substate instead"
                )
            supplies = next(iter(reads), Part.STATE)
            if supplies not in self.parts:
                raise InputError(
                    f"{type(group.model).__name__} reads a {supplies.value}, which this filter does not hold"
                )
            routed[supplies].append(group)
        return routed


@final
class _LineariseGroups(LineariseAt):
    """Terms of all groups, relative to the prior's mean, linearised anywhere in its chart."""

    def __init__(self, marginals: Marginals, prior: Prior, groups: Sequence[Observations]) -> None:
        self._marginals = marginals
        self._prior = prior
        self._groups = groups

    def __call__(self, increment: np.ndarray) -> Terms:
        prior = self._prior
        if increment is prior.mean:
            terms = self._marginals.terms(prior.predicted(), self._groups, prior)
            return terms if prior.centred else terms.charted(prior.space.right_jacobian(increment))
        terms = self._marginals.terms(prior.at(increment), self._groups, prior)
        return terms.charted(prior.space.right_jacobian(increment)).shifted(increment - prior.mean)
