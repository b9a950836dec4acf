"""A Kalman-filtered substate: the second thing that can be marginalised, beside or without a landmark map."""

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from rbpf import gaussian
from rbpf.core.archive import checked
from rbpf.core.conditional import GAUSSIAN
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Conditional, LogDensities, Observations, Part, Transition
from rbpf.core.numeric import linearise
from rbpf.core.proposals import Prior, Terms, take
from rbpf.core.reference import information, stacked
from rbpf.errors import InputError
from rbpf.lie import LieGroup


@final
class KalmanSubstate(Conditional):
    """A linear substate s ~ N(ŝ, P) in every particle, given the sampled states.

    The motion model says how it drives the increment and how it moves (`Transition`): the increment is then itself a
    measurement of it, and is conditioned on exactly. Observations may read it, with the state but not with a landmark.

    Args:
        space: the group of the sampled state.
        mean: (m,) initial mean.
        cov: (m, m) initial covariance, may be singular.

    Attributes:
        mean: (N, m) of each particle.
        cov: (N, m, m), or (1, m, m) as long as it does not differ between particles.
    """

    supplies = Part.SUBSTATE

    def __init__(self, space: LieGroup, mean: np.ndarray, cov: np.ndarray) -> None:
        self.space = space
        self._mean = np.asarray(mean, dtype=float)
        self._cov = np.asarray(cov, dtype=float)
        if self._cov.shape != (self._mean.size, self._mean.size):
            raise InputError(
                f"a substate with mean {self._mean.shape} needs a square cov of that size, got {self._cov.shape}"
            )
        gaussian.psd_factor(self._cov)

    def begin(self, n: int, lineage: Lineage) -> None:
        """Every particle starts with the initial law."""
        self.mean = np.repeat(self._mean[None], n, axis=0)
        self.cov = self._cov[None]

    def predict(self, transition: Transition, space: LieGroup) -> Prior:
        """Joint law of (ε, s_t), Mathematics (joint-substate), kept as s_t | ε."""
        if transition.coupling is None or transition.dynamics is None or transition.drift is None:
            raise InputError(
                "the motion model must give coupling, dynamics and drift: the filter has a Kalman substate"
            )
        d, m = space.dim, self._mean.size
        sizes = (transition.coupling.shape[1:], transition.dynamics.shape[1:], transition.drift.shape[1:])
        if sizes != ((d, m), (m, m), (m,)):
            raise InputError(
                f"the substate has {m} numbers: expected coupling (·, {d}, {m}), dynamics (·, {m}, {m}) and "
                f"drift (·, {m}), the motion model gives (·, …) {sizes}"
            )
        blocks = [transition.coupling, transition.dynamics]
        if blocks[0].shape[0] != blocks[1].shape[0]:
            shared = max(block.shape[0] for block in blocks)
            blocks = [np.broadcast_to(block, (shared, *block.shape[1:])) for block in blocks]
        stack = np.concatenate(blocks, axis=1)
        means = (stack @ self.mean[..., None])[..., 0]
        self._increment_mean = means[:, :d]
        self._predicted = means[:, d:] + transition.drift
        factor = self._condition(stack, transition.noise_factor)
        return Prior(space, transition.mean, self._increment_mean, factor, centred=False)

    def _condition(self, stack: np.ndarray, noise_factor: np.ndarray) -> np.ndarray:
        """Keeps the law of s_t | ε; returns the factor of cov(ε)."""
        from rbpf.kernels.substate import conditioned

        m, parts = self._mean.size, (stack, self.cov, np.ascontiguousarray(noise_factor, dtype=float))
        laws, d = max(part.shape[0] for part in parts), stack.shape[1] - m
        joint, factor = np.empty((laws, d + m, d + m)), np.empty((laws, d, d))
        self._gain, self._rest = np.empty((laws, m, d)), np.empty((laws, m, m))
        if conditioned(*map(np.ascontiguousarray, parts), joint, factor, self._gain, self._rest):
            return factor
        factor = gaussian.psd_factor(joint[:, :d, :d])
        self._gain = joint[:, d:, :d] @ np.linalg.pinv(joint[:, :d, :d], hermitian=True)
        closed = np.concatenate([-self._gain, np.broadcast_to(np.eye(m), (laws, m, m))], axis=2)
        self._rest = gaussian.symmetrise(closed @ joint @ np.swapaxes(closed, -1, -2))
        return factor

    def given(self, increment: np.ndarray) -> np.ndarray:
        """Mean (N, m) of s_t given increments (N, d)."""
        offset = increment - self._increment_mean
        return self._predicted + (self._gain @ offset[..., None])[..., 0]

    def terms(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Terms:
        """All rows that read the substate are stacked: they are correlated through it."""
        increment = self.space.local(prior.base, state)
        nu, jac, noise = self._rows(state, self.given(increment), groups)
        slope = self.space.right_jacobian_inverse(increment)
        jac_state = jac[..., : self.space.dim] + jac[..., self.space.dim :] @ self._gain @ slope
        jac_sub = jac[..., self.space.dim :]
        cov = gaussian.symmetrise(jac_sub @ self._rest @ np.swapaxes(jac_sub, -1, -2)) + noise
        return information(nu[:, None], jac_state[:, None], cov[:, None], GAUSSIAN, prior)

    def correct(
        self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]
    ) -> LogDensities:
        """Conditions on the increment, then on the observations."""
        self.mean, self.cov = self.given(increment), self._rest
        total = np.zeros(state.shape[0])
        if groups:
            nu, jac, noise = self._rows(state, self.mean, groups)
            jac = jac[..., self.space.dim :]
            cov = gaussian.symmetrise(jac @ self.cov @ np.swapaxes(jac, -1, -2)) + noise
            total = gaussian.log_density(nu, cov)
            gain = self.cov @ np.swapaxes(jac, -1, -2) @ gaussian.inverse(cov)
            self.mean = self.mean + np.einsum("nij,nj->ni", gain, nu)
            closed = np.eye(self._mean.size) - gain @ jac
            self.cov = gaussian.symmetrise(
                closed @ self.cov @ np.swapaxes(closed, -1, -2) + gain @ noise @ np.swapaxes(gain, -1, -2)
            )
        return LogDensities(total, np.zeros_like(total))

    def resample(self, ancestors: np.ndarray) -> None:
        """Copies small arrays; what all particles share stays."""
        self._increment_mean = self._increment_mean[ancestors]
        self._predicted = self._predicted[ancestors]
        self._gain = take(self._gain, ancestors)
        self._rest = take(self._rest, ancestors)

    def arrays(self) -> dict[str, np.ndarray]:
        """Means and covariances."""
        return {"substate/mean": self.mean, "substate/cov": self.cov}

    def options(self) -> dict[str, Any]:
        """Its size."""
        return {"substate size": int(self._mean.size)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        m = self._mean.size
        mean = checked(arrays, "substate/mean", self.mean.shape, "f")
        cov = checked(arrays, "substate/cov", (None, m, m), "f")
        if cov.shape[0] not in (1, mean.shape[0]):
            raise InputError(f"the array substate/cov must have 1 or {mean.shape[0]} matrices")
        self.mean, self.cov = mean.copy(), cov.copy()

    def _rows(
        self, state: np.ndarray, substate: np.ndarray, groups: Sequence[Observations]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n, m = substate.shape
        nus, jacs, noises = [], [], []
        for group in groups:
            if group.likelihood is not None and group.likelihood.kernel_id != 0:
                raise InputError(
                    f"{type(group.model).__name__} reads the substate: its likelihood must be Gaussian, "
                    f"not {type(group.likelihood).__name__}"
                )
            nu, jacobians = linearise(
                group.model, self.space, group.z, state[:, None, :], substate=substate[:, None, :]
            )
            assert jacobians.substate is not None
            by_state = np.zeros((1, 1, 1, 1)) if jacobians.state is None else jacobians.state
            blocks = ((by_state, self.space.dim), (jacobians.substate, m))
            jac = np.concatenate(
                [np.broadcast_to(block, (*nu.shape, size)) for block, size in blocks], axis=-1
            )
            for k in range(group.z.shape[0]):
                nus.append(np.broadcast_to(nu[:, k], (n, nu.shape[2])).copy())
                jacs.append(np.broadcast_to(jac[:, k], (n, *jac.shape[2:])).copy())
                noises.append(group.cov[k])
        return stacked(nus, jacs, noises, [None] * len(nus))
