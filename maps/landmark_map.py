"""A growing map of landmarks, each an independent Gaussian given the trajectory (E06 (1), S05 (3))."""

from collections.abc import Sequence
from operator import is_
from typing import Any, final

import numpy as np

from rbpf.core.archive import checked, within
from rbpf.core.genealogy import Lineage
from rbpf.core.likelihoods import Gaussian
from rbpf.core.models import (
    Conditional,
    Jacobians,
    Landmark,
    LogDensities,
    NewLandmarks,
    ObservationModel,
    Observations,
    Part,
    Records,
)
from rbpf.core.numeric import linearise
from rbpf.core.proposals import Prior, Terms
from rbpf.core.reference import innovation_covariance
from rbpf.errors import InputError
from rbpf.lie import LieGroup
from rbpf.maps.layout import Layout
from rbpf.maps.plan import BOTH, MAP, STATE, Plan, by_use, make_plan, require_apart
from rbpf.maps.point import Point
from rbpf.maps.reading import linearise_one_particle, project_compiled, read_records
from rbpf.maps.rows import RowEngine
from rbpf.maps.shared import ALL, SharedStore


@final
class LandmarkMap(Conditional):
    """Landmarks of any parametrisation, shared between particles and copied only when written.

    Args:
        space: the group of the sampled state.
        evidence: keep per particle the log-odds that each landmark exists (unknown association needs it); a
            landmark may then be present in some particles only.
        compiled: use the models' fused kernels where they have one.
    """

    supplies = Part.LANDMARK

    def __init__(self, space: LieGroup, evidence: bool = False, compiled: bool = True) -> None:
        self.space = space
        self.evidence = evidence
        self.compiled = compiled
        self.layouts: list[Layout] = []
        self.catalogue: dict[int, Any] = {}
        self._planned: tuple[Sequence[Observations], Plan] | None = None

    def begin(self, n: int, lineage: Lineage) -> None:
        """An empty map."""
        self.n = n
        self.store = SharedStore(n, lineage)
        self._engine = RowEngine(self.space, self.store, self._layout_of, self.compiled)

    @property
    def ids(self) -> np.ndarray:
        """Landmarks held (M,), in the order in which they were started."""
        return self.store.ids

    def add(self, new_landmarks: NewLandmarks, state: np.ndarray) -> np.ndarray:
        """Starts landmarks from first sightings at the states (N, E); returns their ids (K,)."""
        records = new_landmarks.model.initialise(state, new_landmarks.z, new_landmarks.cov)
        log_odds = None if new_landmarks.mask is None else np.where(new_landmarks.mask, 0.0, -np.inf)
        ids = self.add_records(records, new_landmarks.landmark, log_odds, new_landmarks.ids)
        for landmark, fact in zip(ids.tolist(), new_landmarks.facts, strict=False):
            self.catalogue[landmark] = fact
        return ids

    def add_records(
        self,
        records: Records,
        landmark: Landmark,
        log_odds: np.ndarray | None = None,
        ids: np.ndarray | None = None,
    ) -> np.ndarray:
        """Adds landmarks whose estimates (N, K, …) are known.

        Args:
            records: the estimates.
            landmark: their parametrisation.
            log_odds: (N, K) that they exist, for a map with evidence.
            ids: (K,) that they shall have; by default numbers that no landmark had before.

        Returns:
            Their ids (K,).

        Raises:
            InputError: an id is no number from 0 up, comes twice or is in use, or the shapes do not fit.
        """
        if log_odds is not None and not self.evidence:
            raise InputError("landmarks of some particles only need a map with evidence=True")
        kind = self._kind(landmark)
        columns = self.layouts[kind].pack(records, log_odds)
        given: list[int | None] = [None] * columns.shape[0]
        if ids is not None:
            ids = np.asarray(ids)
            if ids.shape != (columns.shape[0],) or ids.dtype.kind not in "iu" or (ids < 0).any():
                raise InputError(
                    f"ids of {columns.shape[0]} new landmarks must be as many whole numbers from 0 up, got {ids}"
                )
            taken = self.holds(ids)
            if taken.any() or np.unique(ids).size < ids.size:
                twice = ids[taken] if taken.any() else np.sort(ids)[:-1][np.diff(np.sort(ids)) == 0]
                raise InputError(f"a new landmark needs an id of its own: {twice[0]} is in use")
            given = ids.tolist()
        ids = np.array(
            [self.store.add(column, number) for column, number in zip(columns, given, strict=True)],
            dtype=np.int64,
        )
        self.store.columns.kind[self.store.columns.rows(ids)] = kind
        return ids

    def holds(self, ids: np.ndarray) -> np.ndarray:
        """Which of some ids (K,) are those of landmarks held, (K,) bool."""
        return self.store.columns.held(ids)

    def remove(self, ids: np.ndarray) -> None:
        """Drops landmarks from all particles."""
        self._known(ids)
        self._planned = None
        self.store.remove(ids)
        for landmark in ids.tolist():
            self.catalogue.pop(landmark, None)

    def read(self, ids: np.ndarray, particles: np.ndarray | slice = ALL) -> Records:
        """Estimates (N, K, …) of landmarks that share one parametrisation, in all or some particles."""
        ids = np.asarray(ids)
        if ids.size == 0:
            raise InputError("no landmark was named")
        kinds = self.store.columns.kinds(ids)
        if kinds[0] < 0 or (kinds != kinds[0]).any():
            self._known(ids)
            raise InputError("read() takes landmarks of one parametrisation at a time: see `landmark_of`")
        return read_records(self.store, self.layouts[kinds[0]], ids, particles)

    def is_compiled(self, model: ObservationModel, ids: np.ndarray) -> bool:
        """Whether `project` can tell what the model measures of landmarks (K,)."""
        if not self.compiled or type(model).innovation is not ObservationModel.innovation:
            return False
        plain = self._layout_of(int(ids[0])).landmark.components == 1
        return plain and self.store.is_warm(ids) and model.kernel() is not None

    def project(
        self, model: ObservationModel, ids: np.ndarray, anchor: np.ndarray, weights: np.ndarray, prior: Prior
    ) -> tuple[np.ndarray, np.ndarray]:
        """What `Belief.project` gives, relative to the anchors (K, p)."""
        kernel = model.kernel()
        assert kernel is not None
        return project_compiled(self.store, self._layout_of(int(ids[0])), kernel, ids, anchor, weights, prior)

    def innovations(
        self, model: ObservationModel, z: np.ndarray, ids: np.ndarray, state: np.ndarray, particle: int
    ) -> tuple[np.ndarray, Jacobians, Records]:
        """ν (K, p) of landmarks (K,) in one particle at a state (E,), its Jacobians, and the records (1, K, …)."""
        records = self.read(ids, slice(particle, particle + 1))
        kernel = model.kernel() if self.compiled else None
        return *linearise_one_particle(model, kernel, self.space, records, z, state), records

    def landmark_of(self, landmark_id: int) -> Landmark:
        """The parametrisation of a landmark."""
        self._known(np.array([landmark_id]))
        return self._layout_of(landmark_id).landmark

    def are(self, ids: np.ndarray, landmark: Landmark) -> np.ndarray:
        """Which landmarks (K,) of the map have this parametrisation, (K,) bool."""
        return self.store.columns.kinds(ids) == self._kind(landmark)

    def promote(self, ids: np.ndarray, to: Landmark | None = None) -> None:
        """Turns landmarks into single Gaussian points in all particles at once, by their own `promote`."""
        self._planned = None
        for landmark_id in ids:
            layout = self._layout_of(landmark_id)
            column = self.store.read(int(landmark_id))
            records = layout.landmark.promote(layout.unpack(column[None]))
            kind = self._kind(to or Point(records.mean.shape[-1]))
            log_odds = column[-1][:, None] if self.evidence else None
            self.store.replace(int(landmark_id), self.layouts[kind].pack(records, log_odds)[0])
            self.store.columns.kind[self.store.columns.row(int(landmark_id))] = kind

    def ready(self, weights: np.ndarray, fraction: float = 0.95) -> np.ndarray:
        """Landmarks of several components or with constants that are ready in `fraction` of the weight (N,)."""
        waiting = [i for i in self.ids if not isinstance(self.landmark_of(int(i)), Point)]
        ready = [i for i in waiting if (weights * self._is_ready(int(i))).sum() >= fraction]
        return np.array(ready, dtype=np.int64)

    def log_odds(self, ids: np.ndarray) -> np.ndarray:
        """(N, K) log-odds that the landmarks exist; −inf where a particle does not hold one."""
        if not self.evidence:
            return np.zeros((self.n, ids.size))
        return np.array([self.store.read(int(i))[-1] for i in ids]).reshape(ids.size, self.n).T

    def set_log_odds(self, ids: np.ndarray, log_odds: np.ndarray) -> None:
        """Overwrites log-odds (N, K); a landmark at −inf in every particle is removed."""
        if not self.evidence:
            raise InputError("this map keeps no log-odds: build it with evidence=True")
        for landmark_id, column in zip(ids.tolist(), log_odds.T, strict=True):
            record = self.store.read(landmark_id)
            if np.array_equal(record[-1], column):
                continue
            record[-1] = column
            self.store.replace(landmark_id, record)
        gone = ids[np.isneginf(log_odds).all(axis=0)]
        self.remove(gone)

    def terms(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Terms:
        """Information of single-Gaussian landmarks; those of several components enter after sampling."""
        for_state = [group for group in groups if Part.STATE in group.updates]
        return self._engine.terms(self._plan(for_state), state, for_state, prior)

    def correct(
        self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]
    ) -> LogDensities:
        """Log p(z | x) and the landmarks' Kalman updates at the sampled states."""
        uses = by_use(groups)
        require_apart(uses[STATE], uses[BOTH])
        log_density, late = np.zeros(self.n), np.zeros(self.n)
        if uses[STATE]:
            log_density += self._density(state, uses[STATE])
        if uses[BOTH]:
            both = self._engine.correct(self._plan(uses[BOTH]), state, uses[BOTH])
            log_density, late = log_density + both.all, both.late
        if uses[MAP]:
            self._engine.correct(self._plan(uses[MAP]), state, uses[MAP])
        self._planned = None
        return LogDensities(log_density, late)

    def _density(self, state: np.ndarray, groups: Sequence[Observations]) -> np.ndarray:
        """Log p(z | x) (N,) of observations that leave the landmarks as they are."""
        plan = self._plan(groups)
        if plan.late:
            raise InputError("a landmark of several components cannot be observed without being updated")
        if all(group.likelihood is None or group.likelihood.kernel_id == 0 for group in groups):
            terms = self._engine.terms(plan, state, groups, Prior.exactly(self.space, state))
            return terms.log_factor - 0.5 * (terms.quad + terms.log_det)
        if plan.joint:
            raise InputError(
                "a landmark seen twice in a step needs a Gaussian likelihood to be left as it is"
            )
        total = plan.log_factor.copy()
        for batch in plan.batches:
            group, records = groups[batch.group], self.read(batch.ids)
            at, z = state[:, None, :], group.z[batch.ks]
            nu, jac = linearise(group.model, self.space, z, at, records.mean, records.const)
            assert jac.landmark is not None
            cov = innovation_covariance(jac.landmark, records.cov, group.cov[batch.ks])
            log_density = (group.likelihood or Gaussian()).log_density(nu, cov)
            total += (log_density * (1.0 if batch.mask is None else batch.mask)).sum(axis=1)
        return total

    def resample(self, ancestors: np.ndarray) -> None:
        """Nothing is copied: the lineage has advanced. Compacts what has lost its descendants."""
        self.store.compact()

    def arrays(self) -> dict[str, np.ndarray]:
        """Columns and kinds; the catalogue's facts must be numbers or text to be saved."""
        ids = self.ids
        fact_ids = [i for i in ids.tolist() if i in self.catalogue]
        facts = [self.catalogue[i] for i in fact_ids]
        plain = all(isinstance(fact, str | int | float | np.generic) for fact in facts)
        if not plain or len({type(fact) for fact in facts}) > 1:
            raise InputError("facts in the catalogue can be saved if all are numbers or all are text")
        return self.store.arrays() | {
            "map/kinds": self.store.columns.kinds(ids),
            "map/fact_ids": np.array(fact_ids, dtype=np.int64),
            "map/facts": np.array(facts),
        }

    def options(self) -> dict[str, Any]:
        """Whether there are log-odds, and the parametrisations in the order of their numbers."""
        kinds = {
            f"landmark kind {number}": f"{type(kind).__name__} {kind.dim, kind.constants, kind.components}"
            for number, kind in enumerate(layout.landmark for layout in self.layouts)
        }
        return {"evidence": self.evidence, **kinds}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`; the parametrisations must have been registered in the same order.

        Raises:
            InputError: an array is missing, or is not what it should be.
        """
        self.store.restore(arrays)
        count = self.store.columns.count
        kinds = within(arrays, "map/kinds", count, 0, len(self.layouts))
        sizes = np.array([layout.fields for layout in self.layouts], dtype=np.int64)[kinds]
        if not np.array_equal(sizes, self.store.columns.fields[:count]):
            raise InputError("the landmarks' records have other sizes than their parametrisations")
        self.store.columns.kind[:count] = kinds
        named = checked(arrays, "map/fact_ids", (None,), "i")
        if not self.store.columns.held(named).all():
            raise InputError("the array map/fact_ids names a landmark that the map does not hold")
        facts = checked(arrays, "map/facts", (named.size,), "iufbU").tolist()
        self.catalogue = dict(zip(named.tolist(), facts, strict=True))

    def register(self, landmark: Landmark) -> None:
        """Names a parametrisation before it is first used, so that a checkpoint can be read back."""
        self._kind(landmark)

    def _kind(self, landmark: Landmark) -> int:
        for number, layout in enumerate(self.layouts):
            held = layout.landmark
            if type(held) is type(landmark) and vars(held) == vars(landmark):
                return number
        self.layouts.append(Layout(landmark, self.evidence))
        return len(self.layouts) - 1

    def _plan(self, groups: Sequence[Observations]) -> Plan:
        """A step asks for the plan of the same groups again and again; a resampling may have replaced some."""
        planned = self._planned
        if planned is not None and len(planned[0]) == len(groups) and all(map(is_, planned[0], groups)):
            return planned[1]
        plain = np.array([layout.landmark.components == 1 for layout in self.layouts], dtype=bool)
        plan = make_plan(groups, self.n, self.store.columns.kinds, plain)
        self._planned = (groups, plan)
        return plan

    def _layout_of(self, landmark_id: int) -> Layout:
        return self.layouts[self.store.columns.kind[self.store.columns.row(int(landmark_id))]]

    def _known(self, ids: np.ndarray | Sequence[int]) -> None:
        named = np.asarray(ids)
        held = self.store.columns.held(named)
        if not held.all():
            raise InputError(f"the map holds no landmark {named[~held][0]}")

    def _is_ready(self, landmark_id: int) -> np.ndarray:
        layout = self._layout_of(landmark_id)
        return layout.landmark.ready(self.read(np.array([landmark_id])))[:, 0]
