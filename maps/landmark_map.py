"""A growing map of landmarks, conditionally independent Gaussians given the trajectory (E06 (1), S05 (3))."""

from collections.abc import Sequence
from operator import is_
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import integers, read_one
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Belief, Landmark, LogDensities, NewLandmarks, ObservationModel, Observations, Part, Records
from rbpf.core.particles import Information, Particles, Prior
from rbpf.errors import InputError
from rbpf.kernels.landmarks import project
from rbpf.lie import LieGroup
from rbpf.maps import rows
from rbpf.maps.point import Point
from rbpf.maps.rows import BOTH, MAP, STATE
from rbpf.maps.store import ALL, Layout, SharedStore


@final
class LandmarkMap(rows.MapOfRecords):
    """Landmarks of any parametrisation, shared between particles and copied only when written.

    Args:
        space: the group of the sampled state.
        evidence: store per particle the log-odds that each landmark exists (needed for unknown association); a landmark may
            then exist in some particles only.
        compiled: use the fused kernels of models that have one.
        part: its name, for a second map another one than Part.LANDMARK.
    """

    def __init__(
        self, space: LieGroup, evidence: bool = False, compiled: bool = True, part: Part = Part.LANDMARK
    ) -> None:
        self.space = space
        self.supplies = part
        self.evidence = evidence
        self.compiled = compiled
        self.layouts: list[Layout] = []
        self._planned: tuple[Sequence[Observations], rows.Plan] | None = None

    def begin(self, n: int, lineage: Lineage) -> None:
        self.n = n
        self.store = SharedStore(n, lineage)
        self._engine = rows.RowEngine(self.space, self.store, self._layout_of, self.compiled)

    @property
    def ids(self) -> np.ndarray:
        return self.store.ids

    @property
    def stored_fraction(self) -> float:
        return self.store.stored_bytes / max(self.store.dense_bytes, 1)

    def holds(self, ids: np.ndarray) -> np.ndarray:
        return self.store.columns.held(ids)

    def landmark_of(self, landmark_id: int) -> Landmark:
        self._known(np.array([landmark_id]))
        return self._layout_of(landmark_id).landmark

    def are(self, ids: np.ndarray, landmark: Landmark) -> np.ndarray:
        return self.store.columns.kinds(ids) == self.register(landmark)

    def add(self, new_landmarks: NewLandmarks, state: np.ndarray) -> np.ndarray:
        log_odds = None if new_landmarks.mask is None else np.where(new_landmarks.mask, 0.0, -np.inf)
        records = self.first_records(new_landmarks, state)
        return self.add_records(records, new_landmarks.landmark, log_odds, new_landmarks.ids)

    def add_records(
        self, records: Records, landmark: Landmark, log_odds: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> np.ndarray:
        if log_odds is not None and not self.evidence:
            raise InputError("landmarks in some particles only need a map with evidence=True")
        kind = self.register(landmark)
        columns = self.layouts[kind].pack(records, log_odds)
        ids = self.checked_new_ids(ids, len(columns), self.store.columns.next_id)
        self.store.add(columns, ids)
        self.store.columns.kind[self.store.columns.rows(ids)] = kind
        return ids

    def remove(self, ids: np.ndarray) -> None:
        self._known(ids)
        self._planned = None
        self.store.remove(ids)

    def promote(self, ids: Sequence[int] | np.ndarray, to: Landmark | None = None) -> None:
        self._planned = None
        for landmark_id in ids:
            layout = self._layout_of(landmark_id)
            column = self.store.read(int(landmark_id))
            records = layout.landmark.promote(layout.unpack(column[None]))
            kind = self.register(to or Point(records.mean.shape[-1]))
            log_odds = column[-1][:, None] if self.evidence else None
            self.store.replace(np.array([landmark_id]), self.layouts[kind].pack(records, log_odds))
            self.store.columns.kind[self.store.columns.rows(landmark_id)] = kind

    def ready(self, weights: np.ndarray, fraction: float = 0.95) -> np.ndarray:
        """Landmarks with several components or constants that are ready in `fraction` of the weights (N,)."""
        ready = []
        for landmark_id in self.ids.tolist():
            landmark = self.landmark_of(landmark_id)
            if isinstance(landmark, Point):
                continue
            held = landmark.ready(self.read(np.array([landmark_id])))[:, 0]
            if (weights * held).sum() >= fraction:
                ready.append(landmark_id)
        return np.array(ready, dtype=np.int64)

    def read(self, ids: np.ndarray, particles: np.ndarray | slice = ALL) -> Records:
        ids = np.asarray(ids)
        if ids.size == 0:
            raise InputError("no landmark id was given")
        kinds = self.store.columns.kinds(ids)
        if kinds[0] < 0 or (kinds != kinds[0]).any():
            self._known(ids)
            raise InputError("read() takes landmarks of one parametrisation at a time: see `landmark_of`")
        return self.layouts[kinds[0]].unpack(self.store.read_all(ids, particles))

    def moments(self, particles: Particles, of: Part | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `Belief.moments`, over the particles in which a landmark exists, or if it exists in none, over all with it."""
        moments = []
        for landmark_id in (self.ids if isinstance(of, Part) else of).tolist():
            landmark, records = self.landmark_of(landmark_id), self.read(np.array([landmark_id]))
            if not isinstance(landmark, Point):
                records = landmark.promote(records)
            weights = particles.weights
            if self.evidence:
                log_odds = self.log_odds(np.array([landmark_id]))[:, 0]
                exists = weights * (log_odds > 0.0)
                weights = exists if exists.any() else weights * np.isfinite(log_odds)
            moments.append(gaussian.mixture_moments(weights / weights.sum(), records.mean[:, 0], records.cov[:, 0]))
        if not moments:
            return np.zeros((0, 0)), np.zeros((0, 0, 0))
        return np.array([mean for mean, _ in moments]), np.array([cov for _, cov in moments])

    def project(self, model: ObservationModel, ids: np.ndarray, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
        self._known(ids)
        prior, weights, landmark = belief.prior, belief.weights, self._layout_of(int(ids[0])).landmark
        # Models with their own `innovation` are projected by their `predict`.
        is_plain = type(model).innovation is ObservationModel.innovation and landmark.components == 1
        kernel = rows.fused_kernel(model) if self.compiled and is_plain else None
        if kernel is not None:
            k, p = ids.size, model.dim
            mean, cov = np.empty((k, p)), np.empty((k, p, p))
            state, spread = map(np.ascontiguousarray, (prior.predicted(), prior.spread(prior.mean)))
            sizes = np.array([self.space.dim, landmark.dim, landmark.constants])
            fused = kernel.function.address, kernel.params, state
            project(fused, tuple(self.store.access_read_only(ids)), belief.mode, weights, spread, sizes, mean, cov)
            return mean, cov
        return super().project(model, ids, belief)

    def log_odds(self, ids: np.ndarray) -> np.ndarray:
        if not self.evidence:
            return np.zeros((self.n, ids.size))
        return np.array([self.store.read(int(i))[-1] for i in ids]).reshape(ids.size, self.n).T

    def set_log_odds(self, ids: np.ndarray, log_odds: np.ndarray) -> None:
        if not self.evidence:
            raise InputError("this map has no log-odds: build it with evidence=True")
        for landmark_id, column in zip(ids.tolist(), log_odds.T, strict=True):
            record = self.store.read(landmark_id)
            if np.array_equal(record[-1], column):
                continue
            record[-1] = column
            self.store.replace(np.array([landmark_id]), record[None])
        gone = ids[np.isneginf(log_odds).all(axis=0)]
        self.remove(gone)

    def information(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Information:
        """Information of single-Gaussian landmarks; mixtures enter after sampling."""
        for_state = [group for group in groups if Part.STATE in group.updates]
        return self._engine.information(self._plan(for_state), state, for_state, prior)

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        uses: dict[frozenset[Part], list[Observations]] = {STATE: [], BOTH: [], MAP: []}
        for group in groups:
            uses[group.updates].append(group)
        if uses[STATE] and uses[BOTH]:
            # Rows of one landmark are correlated through it; rows that do not update it cannot be stacked with others.
            named = ([np.ravel(each.ids) for each in uses[use] if each.ids is not None] for use in (STATE, BOTH))
            one, other = (np.concatenate(ids) for ids in named)
            shared = np.intersect1d(one[one >= 0], other)
            if shared.size:
                raise InputError(
                    f"landmark {shared[0]} is observed by a group that updates the state alone and by one that updates "
                    "both: split the second into one for each"
                )
        log_density, after_sampling = np.zeros(self.n), np.zeros(self.n)
        if uses[STATE]:
            log_density += self._density(state, uses[STATE])
        if uses[BOTH]:
            both = self._engine.correct(self._plan(uses[BOTH]), state, uses[BOTH])
            log_density, after_sampling = log_density + both.all, both.after_sampling
        if uses[MAP]:
            self._engine.correct(self._plan(uses[MAP]), state, uses[MAP])
        self._planned = None
        return LogDensities(log_density, after_sampling)

    def _density(self, state: np.ndarray, groups: Sequence[Observations]) -> np.ndarray:
        """Log p(z | x) (N,) of observations that do not update the landmarks."""
        plan = self._plan(groups)
        if plan.mixtures:
            raise InputError("a landmark of several components cannot be observed without being updated")
        if all(group.likelihood is None or group.likelihood.kernel_id == 0 for group in groups):
            found = self._engine.information(plan, state, groups, Prior.exactly(self.space, state))
            return found.log_factor - 0.5 * (found.quad + found.log_det)
        if plan.joint:
            raise InputError("a landmark observed twice in a step without being updated needs a Gaussian likelihood")
        total = plan.log_factor.copy()
        for batch in plan.batches:
            *_, log_terms = self._engine.updated(batch, groups[batch.group], state)
            total += log_terms.sum(axis=1)
        return total

    def resample(self, ancestors: np.ndarray) -> None:
        """Nothing is copied: the lineage has advanced. Compacts columns of extinct lineages."""
        self.store.compact()

    def arrays(self) -> dict[str, np.ndarray]:
        return self.store.arrays() | {"map/kinds": self.store.columns.kinds(self.ids)}

    def options(self) -> dict[str, object]:
        """Whether the map has log-odds, and the parametrisations in the order of their numbers."""
        kinds = {
            f"landmark kind {number}": f"{type(kind).__name__} {kind.dim, kind.constants, kind.components}"
            for number, kind in enumerate(layout.landmark for layout in self.layouts)
        }
        return {"evidence": self.evidence, **kinds}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`; the parametrisations must have been registered in the same order."""
        self.store.restore(arrays)
        entry = integers(len(self.ids), least=0, below=len(self.layouts))
        kinds = read_one(arrays, "map/kinds", entry)
        sizes = np.array([layout.fields for layout in self.layouts], dtype=np.int64)[kinds]
        if not np.array_equal(sizes, self.store.columns.fields):
            raise InputError("the landmarks' records have other sizes than their parametrisations")
        self.store.columns.kind[:] = kinds

    def register(self, landmark: Landmark) -> int:
        """Registers a parametrisation before its first use, so that a checkpoint can be loaded; returns its number.

        The saving and the loading filter must register the same ones in the same order.
        """
        layout = Layout(landmark, self.evidence)
        if layout not in self.layouts:
            self.layouts.append(layout)
        return self.layouts.index(layout)

    def _plan(self, groups: Sequence[Observations]) -> rows.Plan:
        """Cached, as a step needs the plan of the same groups several times; a resampling may have replaced some."""
        planned = self._planned
        if planned is not None and len(planned[0]) == len(groups) and all(map(is_, planned[0], groups)):
            return planned[1]
        plain = np.array([layout.landmark.components == 1 for layout in self.layouts], dtype=bool)
        plan = rows.make_plan(groups, self.n, self.store.columns.kinds, plain)
        self._planned = (groups, plan)
        return plan

    def _layout_of(self, landmark_id: int) -> Layout:
        return self.layouts[self.store.columns.kind[self.store.columns.rows(landmark_id)]]

    def _known(self, ids: np.ndarray | Sequence[int]) -> None:
        named = np.asarray(ids)
        held = self.store.columns.held(named)
        if not held.all():
            raise InputError(f"the map has no landmark {named[~held][0]}")
