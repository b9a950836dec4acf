"""Landmark observations of a step: which are processed jointly, their information, and their updates.

Rows of different landmarks are independent given the state; rows of one landmark that a particle observes
twice in a step (two cameras, two groups) are correlated through it and are stacked. Rows run compiled where the model
has a kernel, else in NumPy.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core import linearisation
from rbpf.core.likelihoods import Gaussian
from rbpf.core.linearisation import EVERYTHING, linearise
from rbpf.core.models import (
    NEW,
    NULL,
    Belief,
    FusedKernel,
    Jacobians,
    Likelihood,
    LogDensities,
    Map,
    NewLandmarks,
    ObservationModel,
    Observations,
    Part,
    Records,
)
from rbpf.core.particles import Information, Prior
from rbpf.errors import InputError
from rbpf.kernels.landmarks import given_rows, linearise_group, refine, update
from rbpf.kernels.signature import BLOCK, run_driver
from rbpf.lie import Array, LieGroup
from rbpf.maps.store import Layout, SharedStore

#: What observations update.
STATE, MAP = frozenset({Part.STATE}), frozenset({Part.LANDMARK})
BOTH = STATE | MAP
#: Numbers (K,) of the parametrisations of landmarks (K,), -1 if not in the map.
Kinds = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Row:
    """Measurement k of a group, of one landmark, in the particles of `mask` (N,); None is all."""

    group: int
    k: int
    landmark: int
    mask: np.ndarray | None


@dataclass
class Batch:
    """Independent rows of one group: measurements `ks` (K,) of landmarks `ids` (K,), in `mask` (N, K) or all."""

    group: int
    ks: np.ndarray
    ids: np.ndarray
    mask: np.ndarray | None = None
    #: Inputs of the drivers in all stages of a step, in parts; computed on first use.
    for_drivers: "list[ForDrivers]" = field(default_factory=list)

    def some(self, rows: np.ndarray | slice) -> "Batch":
        """The batch of some rows."""
        mask = None if self.mask is None else self.mask[:, rows]
        return Batch(self.group, self.ks[rows], self.ids[rows], mask)


class ForDrivers(NamedTuple):
    """The drivers' inputs for a part of a batch that do not depend on the states."""

    ids: np.ndarray
    kernel: FusedKernel | None  #: None if the model is linearised in NumPy.
    #: z (K, p), their covariances, the mask (K, N) or (0, 0), and the likelihood's number and parameters.
    measured: tuple[np.ndarray, np.ndarray, np.ndarray, int, np.ndarray]
    sizes: np.ndarray  #: d, D, A.


@dataclass
class Plan:
    """All rows of a step, and the log-densities (N,) of new and clutter observations.

    Independent rows of single-Gaussian landmarks, rows that share a landmark, and rows of mixture landmarks,
    which enter after sampling.
    """

    log_factor: np.ndarray
    batches: list[Batch] = field(default_factory=list)
    joint: list[list[Row]] = field(default_factory=list)
    mixtures: list[Row] = field(default_factory=list)


def make_plan(groups: Sequence[Observations], n: int, kinds: Kinds, plain: np.ndarray) -> Plan:
    """Sorts the rows of all groups that read landmarks.

    `kinds` gives landmarks (K,) the numbers (K,) of their parametrisations, -1 if not in the map; `plain` (kinds,)
    tells which are single Gaussians. Raises InputError: ids are missing, of a wrong shape, or not in the map.
    """
    plan = Plan(np.zeros(n))
    found = [_checked_ids(group, n, kinds) for group in groups]
    named = [ids for ids, _ in found]
    for group, ids in zip(groups, named, strict=True):
        for outcome, log_density in ((NEW, group.log_new), (NULL, group.log_clutter)):
            if log_density != 0.0:
                count = (ids == outcome).sum(axis=-1)
                plan.log_factor += np.where(count > 0, log_density, 0.0) * count
    # Fast path: all particles agree, no landmark is observed twice, and each group has one plain parametrisation.
    seen = [landmark for ids in named if ids.ndim == 1 for landmark in ids.tolist() if landmark >= 0]
    agreed = all(ids.ndim == 1 for ids in named) and len(set(seen)) == len(seen)
    # A group without landmarks has no kind that could differ.
    if agreed and all(of.size == 0 or (plain[of[0]] and (of == of[0]).all()) for _, of in found):
        chosen = [np.flatnonzero(ids >= 0) for ids in named]
        plan.batches = [Batch(number, ks, named[number][ks]) for number, ks in enumerate(chosen) if ks.size]
        return plan
    rows: dict[int, list[Row]] = {}
    for number, ids in enumerate(named):
        for row in _rows(number, ids):
            rows.setdefault(row.landmark, []).append(row)
    batches: dict[tuple[int, int], list[Row]] = {}
    for landmark, observed in rows.items():
        kind = int(kinds(np.array([landmark]))[0])
        if not plain[kind]:
            plan.mixtures.extend(observed)
            continue
        # Whether any particle observes the landmark in two rows.
        masks = [row.mask for row in observed if row.mask is not None]
        if len(observed) > 1 and (len(masks) < len(observed) or (np.sum(masks, axis=0) > 1).any()):
            plan.joint.append(observed)
            continue
        for row in observed:
            batches.setdefault((row.group, kind), []).append(row)
    for together in batches.values():
        ks, ids = np.array([row.k for row in together]), np.array([row.landmark for row in together])
        batch = Batch(together[0].group, ks, ids)
        if any(row.mask is not None for row in together):
            everyone = np.ones(n, dtype=bool)
            mask = np.array([everyone if row.mask is None else row.mask for row in together])
            batch.mask = np.ascontiguousarray(mask.T)
        plan.batches.append(batch)
    return plan


def _checked_ids(group: Observations, n: int, kinds: Kinds) -> tuple[np.ndarray, np.ndarray]:
    """The ids of a group's measurements, and the kinds of those that are landmarks."""
    ids, count = group.ids, group.z.shape[0]
    if ids is None:
        raise InputError(f"{type(group.model).__name__} reads a landmark: its observations need ids")
    if ids.shape not in ((count,), (n, count)):
        raise InputError(f"ids of {count} measurements must be ({count},) or ({n}, {count}), got {ids.shape}")
    if ids.dtype.kind != "i" or (ids.size and ids.min() < NEW):
        raise InputError(f"ids of {type(group.model).__name__} must be integers: landmarks, NULL = -1 or NEW = -2")
    named = ids[ids >= 0]
    of = kinds(named)
    if (of < 0).any():
        raise InputError(f"a measurement is of landmark {named[of < 0][0]}, which is not in the map")
    return ids, of


def _rows(number: int, ids: np.ndarray) -> list[Row]:
    if ids.ndim == 1:
        return [Row(number, k, landmark, None) for k, landmark in enumerate(ids.tolist()) if landmark >= 0]
    rows = []
    for k, column in enumerate(ids.T):
        for landmark in np.unique(column[column >= 0]):
            mask = column == landmark
            rows.append(Row(number, k, int(landmark), None if mask.all() else mask))
    return rows


GAUSSIAN = Gaussian()
_NO_MASK = np.zeros((0, 0), dtype=np.bool_)
#: Particle-observation pairs processed at once by NumPy, so that the arrays fit the second-level cache.
PAIRS_AT_ONCE = 8192


class RowEngine:
    """Linearises and updates the columns of a store."""

    def __init__(self, space: LieGroup, store: SharedStore, layout_of: Callable[[int], Layout], compiled: bool) -> None:
        self.space = space
        self.store = store
        self.layout_of = layout_of
        self.compiled = compiled

    def information(self, plan: Plan, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Information:
        """Information of all rows except mixtures, about a right perturbation of the states (N, E)."""
        n = state.shape[0]
        total = Information.zeros(n, self.space.dim)
        total.log_factor += plan.log_factor
        out = total.info, total.vector, total.quad, total.log_det, total.rows
        for batch in plan.batches:
            group = groups[batch.group]
            if not self._is_compiled(group):
                total.add(self._information_numpy(batch, group, state, prior))
                continue
            factor = np.ascontiguousarray(prior.factor)
            for taken in self._for_drivers(batch, group):
                fused, measured = self._observed(taken, group, state, EVERYTHING)
                access, pairs = self.store.access(taken.ids), n * taken.ids.size
                run_driver(refine, pairs, -(-n // BLOCK), *fused, *access, *measured, factor, taken.sizes, *out)
        for rows in plan.joint:
            nu, jac, records, noise, log_factor, used = self._joint(rows, groups, state, prior)
            jac_map = jac[..., self.space.dim :]
            cov = gaussian.symmetrise(jac_map @ records.cov[:, 0] @ np.swapaxes(jac_map, -1, -2)) + noise
            jac_state = jac[..., : self.space.dim]
            found = linearisation.information(nu[:, None], jac_state[:, None], cov[:, None], GAUSSIAN, prior)
            total.add(replace(found, rows=used))
            total.log_factor += log_factor
            literal = np.repeat(
                [not _likelihood(groups[row.group]).normalised for row in rows],
                [groups[row.group].model.dim for row in rows],
            )
            # ½ log|2πS| of rows whose likelihood is not normalised.
            chol = gaussian.cholesky(2.0 * np.pi * cov[:, literal][:, :, literal])
            total.log_factor += 0.5 * gaussian.log_det(chol)
        return total

    def correct(self, plan: Plan, state: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        log_density, n = plan.log_factor.copy(), state.shape[0]
        for batch in plan.batches:
            group = groups[batch.group]
            if not self._is_compiled(group):
                for part in _one_after_the_other(batch):
                    self._correct_once(part, group, state, log_density)
                continue
            for taken in self._for_drivers(batch, group):
                fused, measured = self._observed(taken, group, state, MAP)
                access, targets = self.store.rewrite(taken.ids)
                what = *fused, *access, *measured, targets, taken.sizes, log_density
                run_driver(update, n * taken.ids.size, -(-n // BLOCK), *what)
        for rows in plan.joint:
            self._correct_joint(rows, groups, state, log_density)
        after_sampling = np.zeros(n)
        for row in plan.mixtures:
            after_sampling += self._correct_mixture(row, groups[row.group], state)
        return LogDensities(log_density + after_sampling, after_sampling)

    def _is_compiled(self, group: Observations) -> bool:
        return self.compiled and _likelihood(group).kernel_id >= 0

    def _for_drivers(self, batch: Batch, group: Observations) -> list[ForDrivers]:
        """The drivers' inputs of a batch: whole, or in parts that NumPy can linearise in the cache."""
        if not batch.for_drivers:
            kernel, parts = fused_kernel(group.model), [batch]
            if kernel is None:
                size = max(1, PAIRS_AT_ONCE // self.store.n)
                parts = [
                    part.some(slice(first, first + size))
                    for part in _one_after_the_other(batch)
                    for first in range(0, part.ks.size, size)
                ]
            likelihood, landmark = _likelihood(group), self.layout_of(int(batch.ids[0])).landmark
            params = numbers(likelihood.params, "the params of a likelihood")
            sizes = np.array([self.space.dim, landmark.dim, landmark.constants])
            for part in parts:
                mask = _NO_MASK if part.mask is None else np.ascontiguousarray(part.mask.T)
                measured = group.z[part.ks], group.cov[part.ks], mask, likelihood.kernel_id, params
                batch.for_drivers.append(ForDrivers(part.ids, kernel, measured, sizes))
        return batch.for_drivers

    def _observed(
        self, part: ForDrivers, group: Observations, state: np.ndarray, by: frozenset[Part]
    ) -> tuple[tuple[int, np.ndarray, np.ndarray], tuple[Any, ...]]:
        """Common inputs of both drivers: the kernel and the states; the measurements and their likelihood.

        A model without a kernel is linearised in NumPy, and its rows are passed instead.
        """
        kernel, (z, *likelihood) = part.kernel, part.measured
        if kernel is None:
            mean, const = self.layout_of(int(part.ids[0])).estimates(self.store.read_all(part.ids))
            nu, jac = linearise(group.model, self.space, z, state[:, None], mean, const, by=by)
            rows = np.concatenate([nu[..., None], *(block for block in jac if block is not None)], axis=-1)
            z = np.zeros_like(z)
            z[:, 0] = np.arange(len(z)) * rows[0, 0].size
            by_state = 0 if jac.state is None else self.space.dim
            kernel, state = FusedKernel(given_rows, np.array([by_state], dtype=float)), rows.reshape(len(state), -1)
        return (kernel.function.address, kernel.params, np.ascontiguousarray(state)), (z, *likelihood)

    def _read(self, ids: np.ndarray) -> tuple[np.ndarray, Records]:
        columns = self.store.read_all(ids)
        return columns, self.layout_of(int(ids[0])).unpack(columns)

    def _write(self, ids: np.ndarray, columns: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> None:
        """Writes new Gaussians (N, K, …) into columns (K, fields, N); other fields are unchanged."""
        fields = np.concatenate([mean, gaussian.pack(cov)], axis=-1)
        fields = np.moveaxis(fields.reshape(*fields.shape[:2], -1), 0, -1)
        columns[:, : fields.shape[1]] = fields
        self.store.replace(ids, columns)

    def _information_numpy(self, batch: Batch, group: Observations, state: np.ndarray, prior: Prior) -> Information:
        _, records = self._read(batch.ids)
        nu, jac = linearise(group.model, self.space, group.z[batch.ks], state[:, None], records.mean, records.const)
        assert jac.state is not None and jac.landmark is not None
        cov = linearisation.innovation_covariance(jac.landmark, records.cov, group.cov[batch.ks])
        return linearisation.information(nu, jac.state, cov, _likelihood(group), prior, batch.mask)

    def _correct_once(self, batch: Batch, group: Observations, state: Array, log_density: Array) -> None:
        columns, mean, cov, log_terms = self.updated(batch, group, state)
        log_density += log_terms.sum(axis=1)
        self._write(batch.ids, columns, mean, cov)

    def updated(self, batch: Batch, group: Observations, state: Array) -> tuple[Array, Array, Array, Array]:
        """The columns that a batch updates, and `linearisation.updated` of them; nothing is written."""
        columns, records = self._read(batch.ids)
        found = self._updated(group, batch.ks, state, records.mean, records.cov, records.const, batch.mask)
        return columns, *found

    def _joint(
        self, rows: list[Row], groups: Sequence[Observations], state: np.ndarray, prior: Prior | None = None
    ) -> tuple[np.ndarray, np.ndarray, Records, np.ndarray, np.ndarray, np.ndarray]:
        """Stacked ν (N, Σp), [H J], the landmark's records, R, the log-density of rows taken as outliers, and rows used (N,).

        With a prior, rows with a non-Gaussian likelihood are used only if they pass its gate.
        """
        _, records = self._read(np.array([rows[0].landmark]))
        nus, jacs, noises, masks = [], [], [], []
        log_factor, used = np.zeros(state.shape[0]), np.zeros(state.shape[0])
        for row in rows:
            group = groups[row.group]
            z = group.z[row.k : row.k + 1]
            nu, jac = linearise(group.model, self.space, z, state[:, None, :], records.mean, records.const)
            assert jac.state is not None and jac.landmark is not None
            mask = row.mask
            likelihood = _likelihood(group)
            if prior is not None and likelihood.kernel_id != 0:
                cov = linearisation.innovation_covariance(jac.landmark, records.cov, group.cov[row.k])
                mask, log_row = linearisation.gated(nu, jac.state, cov, likelihood, prior, mask)
                log_factor += log_row
            nus.append(nu[:, 0].copy())
            jacs.append(np.concatenate([jac.state[:, 0], jac.landmark[:, 0]], axis=-1))
            noises.append(group.cov[row.k])
            masks.append(mask)
            used += group.model.dim * (1.0 if mask is None else mask.reshape(-1))
        nu, jac_all, noise = linearisation.stacked(nus, jacs, noises, masks)
        return nu, jac_all, records, noise, log_factor, used

    def _correct_joint(self, rows: list[Row], groups: Sequence[Observations], state: Array, log_density: Array) -> None:
        """Stacked if all rows are Gaussian; else sequentially, each with the density of its own likelihood.

        They are sorted by measurement, so that the order within a frame does not matter.
        """
        if any(_likelihood(groups[row.group]).kernel_id != 0 for row in rows):
            for row in sorted(rows, key=lambda row: groups[row.group].z[row.k].tolist()):
                mask = None if row.mask is None else row.mask[:, None]
                batch = Batch(row.group, np.array([row.k]), np.array([row.landmark]), mask)
                self._correct_once(batch, groups[row.group], state, log_density)
            return
        nu, jac, records, noise, _, _ = self._joint(rows, groups, state)
        jac_map = jac[:, None, :, self.space.dim :]
        mean, cov, log_terms = linearisation.updated(
            nu[:, None], jac_map, records.mean, records.cov, noise[:, None], GAUSSIAN, None
        )
        log_density += log_terms[:, 0]
        ids = np.array([rows[0].landmark])
        self._write(ids, self._read(ids)[0], mean, cov)

    def _correct_mixture(self, row: Row, group: Observations, state: np.ndarray) -> np.ndarray:
        """p(z | x) = Σ_c w_c p(z | x, c); every component is updated, and its weight by its own density."""
        ids = np.array([row.landmark])
        columns, records = self._read(ids)
        assert records.log_weights is not None
        mask = None if row.mask is None else row.mask[:, None]
        mean, cov, log_terms = self._updated(
            group, row.k, state, records.mean[:, 0], records.cov[:, 0], records.const, mask
        )
        joint = records.log_weights[:, 0] + log_terms
        total = np.logaddexp.reduce(joint, axis=1)
        end = self.layout_of(row.landmark).gaussian_fields * mean.shape[1]
        columns[0, end : end + mean.shape[1]] = (joint - total[:, None]).T
        self._write(ids, columns, mean[:, None], cov[:, None])
        return total

    def _updated(
        self, group: Observations, ks: Any, state: Array, mean: Array, cov: Array, const: Array | None, mask: Any
    ) -> tuple[Array, Array, Array]:
        """`linearisation.updated` by some measurements of a group, at sampled states."""
        nu, jac = linearise(group.model, self.space, group.z[ks], state[:, None], mean, const, by=MAP)
        assert jac.landmark is not None
        return linearisation.updated(nu, jac.landmark, mean, cov, group.cov[ks], _likelihood(group), mask)


def fused_kernel(model: ObservationModel) -> FusedKernel | None:
    """A model's kernel, its constants as the drivers take them."""
    kernel = model.kernel()
    if kernel is None:
        return None
    return FusedKernel(kernel.function, numbers(kernel.params, f"the params of {type(model).__name__}'s kernel"))


def _one_after_the_other(batch: Batch) -> list[Batch]:
    """Splits a batch so that a landmark associated with several measurements is updated sequentially."""
    parts, pending = [], np.arange(batch.ids.size)
    while pending.size:
        _, first = np.unique(batch.ids[pending], return_index=True)
        parts.append(batch.some(pending[first]))
        pending = np.delete(pending, first)
    return parts


def _likelihood(group: Observations) -> Likelihood:
    return group.likelihood or GAUSSIAN


class MapOfRecords(Map):
    """Common base of the maps: ids of new landmarks, and predicted measurements."""

    space: LieGroup
    compiled: bool  #: use the fused kernels of models that have one.

    def checked_new_ids(self, ids: np.ndarray | None, count: int, next_id: int) -> np.ndarray:
        """Ids (K,) of `count` new landmarks, by default from `next_id` on; errors as of `add_records`."""
        if ids is None:
            return np.arange(next_id, next_id + count)
        ids = np.asarray(ids)
        if ids.shape != (count,) or ids.dtype.kind not in "iu" or (ids < 0).any():
            raise InputError(f"ids of {count} new landmarks must be as many whole numbers from 0 up, got {ids}")
        numbers, times = np.unique(ids, return_counts=True)
        taken = numbers[self.holds(numbers) | (times > 1)]
        if taken.size:
            raise InputError(f"a new landmark needs an id of its own: {taken[0]} is in use")
        return ids.astype(np.int64)

    def first_records(self, new: NewLandmarks, state: np.ndarray) -> Records:
        """Estimates (N, K, …) of landmarks initialised from states (N, E)."""
        name = type(new.model).__name__
        return new.model.initialise(state, numbers(new.z, f"z of {name}"), numbers(new.cov, f"cov of {name}"))

    def expected(self, model: ObservationModel, ids: np.ndarray, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
        prior, state, records = belief.prior, belief.state[:, None, :], self.read(ids)
        predicted = model.predict(state, records.mean, records.const)
        _, (by_state, by_landmark, _) = linearise(model, prior.space, predicted, state, records.mean, records.const)
        assert by_state is not None and by_landmark is not None
        moved = by_state @ prior.spread(prior.mean)[:, None]
        within = by_landmark @ records.cov @ np.swapaxes(by_landmark, -1, -2)
        return predicted, gaussian.symmetrise(within + moved @ np.swapaxes(moved, -1, -2))

    def innovations(
        self, model: ObservationModel, z: np.ndarray, ids: np.ndarray, state: np.ndarray, particle: int
    ) -> tuple[Array, Jacobians, Records]:
        space, records = self.space, self.read(ids, slice(particle, particle + 1))
        kernel, const = fused_kernel(model) if self.compiled else None, records.const
        if kernel is None:
            nu, jac = linearise(model, space, z, state, records.mean, const)
            assert jac.state is not None and jac.landmark is not None
            return nu[0], Jacobians(jac.state[0], jac.landmark[0]), records
        (_, k, dim), p = records.mean.shape, z.shape[1]
        said, slope = np.zeros((k * p, 1 + space.dim, 1)), np.zeros((k * p, dim))
        columns, none = np.arange(k * dim).reshape(k, dim), np.zeros((k, 0), dtype=np.int64)
        arrays = state[None], records.mean.reshape(1, -1), np.empty((k, 0)) if const is None else const[0], z
        at, mean, origins, z = (numbers(array, "what a kernel takes") for array in arrays)
        linearise_group(kernel.function.address, kernel.params, at, mean, columns, none, origins, z, 0, said, slope)
        nu, by_state = said[:, 0].reshape(k, p), said[:, 1:].reshape(k, p, space.dim)
        return nu, Jacobians(by_state, slope.reshape(k, p, dim)), records
