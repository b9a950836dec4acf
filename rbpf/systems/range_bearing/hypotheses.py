"""Unknown association on a joint map: several weighted hypotheses, each with its own Gaussian.

A hypothesis is a filter with its own joint map and one association for all of its particles. In each frame the most probable
associations are searched in every hypothesis; those that differ in a relevant landmark and are not much less probable are
kept in parallel. The decision is left to the evidence of later frames: no moments are taken over hypotheses, and one is
dropped only for its low weight, or as the lightest of too many.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from rbpf.core.checkpoint import integers, numbers, read, split
from rbpf.core.filter import Filter, StepReport, checked_observations
from rbpf.core.likelihoods import associations, squared_mahalanobis
from rbpf.core.models import NEW, NULL, Observations, Part
from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.maps.joint_map import JointMap
from rbpf.motion.odometry import Odometry
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.range_bearing import RelativePosition, RigidPointModel
from rbpf.systems.range_bearing.config import AssociationConfig
from rbpf.systems.system import DIAGNOSTICS, Column

HYPOTHESES = Column("hypotheses", "explanations kept side by side", kind=int, table=DIAGNOSTICS)
_ODDS = {"ids": integers("landmarks", least=0), "log_odds": numbers("landmarks")}
_KEPT = {"counts": integers("steps", least=0), "chosen": integers("readings", least=NULL)}


@dataclass
class Hypothesis:
    """One association of all measurements so far, with its filter."""

    filter: Filter
    log_weight: float = 0.0
    log_odds: dict[int, float] = field(default_factory=dict)  #: log-odds that a landmark exists, by name.
    #: landmark of every measurement, step by step, if kept.
    chosen: list[np.ndarray] = field(default_factory=list)

    @property
    def map(self) -> JointMap:
        held = self.filter.marginals.parts[Part.LANDMARK]
        assert isinstance(held, JointMap)
        return held

    def copied(self) -> "Hypothesis":
        """A copy; random generator, motion and sensors are shared."""
        shared = self.filter.rng, self.filter.motion, self.filter.space, *self.filter.sensors, *self.chosen
        return copy.deepcopy(self, {id(one): one for one in shared})


class _View(NamedTuple):
    """Names (M,) of landmarks, and their predictions relative to the robot: (M, D), (M, D, D)."""

    ids: np.ndarray
    mean: np.ndarray
    cov: np.ndarray


class _Explanation(NamedTuple):
    """Association of a frame by a hypothesis: names (K,), NEW or NULL, the prediction, and nearby landmarks afterwards."""

    log_weight: float
    parent: Hypothesis
    chosen: np.ndarray
    before: _View
    after: _View
    recalls: bool  #: a landmark that only an old sub-map has


class Hypotheses:
    """A bounded set of hypotheses, the most probable one first.

    Args:
        filter_: on a joint map, with a sensor of named landmarks; the names are assigned here.
        model: the observation model.
        config: settings of the association.
        keep: store every association.
    """

    def __init__(self, filter_: Filter, model: RigidPointModel, config: AssociationConfig, keep: bool = False) -> None:
        self.held = [Hypothesis(filter_)]
        self.model, self.gates, self.existence, self.keep = model, config.gates(model.dim), config.existence(), keep
        self.most, self.bound = config.hypotheses, -float(np.log(config.least_weight))
        self._next = 0

    def step(
        self, z: Array, cov_z: Array, control: Odometry | None, stamp_ns: int | None
    ) -> tuple[np.ndarray, StepReport]:
        """A step of every hypothesis: names (K,), NULL for clutter, and report of the best one, with the evidence of all.

        Errors as of `Filter.step`.
        """
        checked = checked_observations(Observations(z, cov_z, self.model))
        # Associations by predicted weight: those that differ from all weightier ones.
        found = list[_Explanation]()
        for one in sorted(self._explained(checked, control, stamp_ns), key=lambda one: -one.log_weight):
            if len(found) == self.most or (found and one.log_weight < found[0].log_weight - self.bound):
                break
            if all(self._differ(one, other) for other in found):
                found.append(one)

        # A measurement that is new in several of them gets the same name in all.
        new = np.any([one.chosen == NEW for one in found], axis=0)
        fresh = self._next + np.cumsum(new) - 1
        self._next += int(new.sum())
        # The last association of a hypothesis continues in it, the others in copies.
        last = {id(one.parent): one for one in found}
        held = [one.parent if last[id(one.parent)] is one else one.parent.copied() for one in found]
        named, reports = list[np.ndarray](), list[StepReport]()
        for each, one in zip(held, found, strict=True):
            named.append(np.where(one.chosen == NEW, fresh, one.chosen))
            reports.append(self._stepped(each, named[-1], checked, control, stamp_ns))
            gained = reports[-1].log_evidence
            costs = self.gates.log_new * (one.chosen == NEW).sum() + self.gates.log_clutter * (one.chosen == NULL).sum()
            # The predicted density if the likelihood is not normalised, or for landmarks of old sub-maps.
            predicted = np.isnan(gained) or one.recalls
            each.log_weight = one.log_weight if predicted else each.log_weight + gained + float(costs)

        # Their weights, and the evidence of the frame by all of them.
        evidence = float(np.logaddexp.reduce([each.log_weight for each in held]))
        order = sorted(range(len(held)), key=lambda i: -held[i].log_weight)
        first = order[0]
        self.held = [held[i] for i in order if held[i].log_weight >= held[first].log_weight - self.bound]
        rest = float(np.logaddexp.reduce([each.log_weight for each in self.held]))
        for each in self.held:
            each.log_weight -= rest
        report = reports[first]
        return named[first], report if np.isnan(report.log_evidence) else replace(report, log_evidence=evidence)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a checkpoint besides the first hypothesis's filter."""
        arrays = {"log_weights": np.array([each.log_weight for each in self.held]), "next": np.array([self._next])}
        for i, each in enumerate(self.held):
            own = each.filter.arrays() if i else {}
            own |= {"odds/ids": np.array(list(each.log_odds), dtype=np.int64)}
            own |= {"odds/log_odds": np.array(list(each.log_odds.values()), dtype=float)}
            own |= {"kept/counts": np.array([names.size for names in each.chosen], dtype=np.int64)}
            own |= {"kept/chosen": np.concatenate([np.zeros(0, dtype=np.int64), *each.chosen])}
            arrays |= {f"{i}/{name}": array for name, array in own.items()}
        return {f"hypotheses/{name}": array for name, array in arrays.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`, once the first filter is restored. Raises InputError: an array does not fit."""
        schema = {"log_weights": numbers("hypotheses"), "next": integers(1, least=0)}
        log_weights, following = read(arrays, schema, "hypotheses/").values()
        if not 1 <= log_weights.size <= self.most:
            raise InputError(f"the array hypotheses/log_weights must have 1 to {self.most} rows: {log_weights.size}")
        held = list[Hypothesis]()
        for i, log_weight in enumerate(log_weights.tolist()):
            place = f"hypotheses/{i}/"
            own = {name.removeprefix(place): array for name, array in arrays.items() if name.startswith(place)}
            each = Hypothesis(self.held[0].filter) if not i else held[0].copied()
            if i:
                each.filter.restore(own)
            odds, kept = read(own, _ODDS, "odds/"), read(own, _KEPT, "kept/")
            if not np.array_equal(np.unique(odds["ids"]), np.sort(each.map.all_ids)):
                raise InputError(f"the array {place}odds/ids does not name the landmarks of the map")
            each.log_weight, each.log_odds = log_weight, dict(zip(*(odds[name].tolist() for name in odds), strict=True))
            each.chosen = split(kept["chosen"], kept["counts"].tolist(), f"{place}kept/chosen")
            held.append(each)
        self.held, self._next = held, int(following[0])

    def _stepped(
        self, each: Hypothesis, names: np.ndarray, group: Observations, control: Odometry | None, stamp_ns: int | None
    ) -> StepReport:
        """A step with the assigned names; then lowers the log-odds of landmarks expected but not observed, or drops them."""
        used, ids = names != NULL, each.map.ids
        held = set(ids.tolist())
        shown = FeatureFrame(stamp_ns or 0, names[used], group.z[used], group.cov[used])
        each.filter.health.silent = self.held[0].filter.health.silent
        report = each.filter.step(shown, control, stamp_ns)
        if self.keep:
            each.chosen.append(names)
        log_odds = each.log_odds | {
            name: each.log_odds.get(name, -self.existence.hit) + self.existence.hit
            for name in names[used].tolist()
            if name not in held
        }
        ids = ids[each.map.holds(ids)]
        if ids.size:
            belief = each.filter.belief()
            mode = slice(belief.mode, belief.mode + 1)
            expected = self.model.visible(belief.state[mode, None], belief.read_mode(ids).mean)
            before = np.array([[each.log_odds[name] for name in ids.tolist()]])
            moved = self.existence.updated(before, np.isin(ids, names)[None], expected)[0]
            gone = np.isneginf(moved)
            if gone.any():
                each.map.remove(ids[gone])
                for name in ids[gone].tolist():
                    del log_odds[name]
            log_odds |= dict(zip(ids[~gone].tolist(), moved[~gone].tolist(), strict=True))
        each.log_odds = log_odds
        return report

    def _explained(self, group: Observations, control: Odometry | None, stamp_ns: int | None) -> Iterator[_Explanation]:
        """Associations of the observations, by all hypotheses."""
        # Points relative to the robot are linear in the map, whatever the measurement.
        seen, origin = RelativePosition(self.model.space), self.model.space.identity()[None]
        points = self.model.initialise(origin, group.z, group.cov)
        z, noise = points.mean[0], points.cov[0]
        log_unit = 0.5 * (np.linalg.slogdet(noise)[1] - np.linalg.slogdet(group.cov)[1])
        for each in self.held:
            # Includes nearby landmarks of old sub-maps; a matched one is added to the current sub-map, too.
            belief, wide = each.filter.expect(control, stamp_ns), each.map.widened()
            ids, dim = wide.ids, z.shape[1]
            view = _View(ids, np.zeros((0, dim)), np.zeros((0, dim, dim)))
            near, mean, cov = ids, view.mean, np.zeros((0, 0))
            if ids.size:
                # Landmarks near any of the measurements, and their joint prediction.
                view = _View(ids, *wide.project(seen, ids, belief))
                squared = squared_mahalanobis(z[:, None] - view.mean, view.cov + noise[:, None])
                near = ids[(squared <= self.gates.isolate).any(axis=0)]
                if near.size:
                    mean, cov = wide.project_jointly(seen, near, belief)
            for one in associations(z, noise, mean, cov, self.gates, log_unit, self.bound):
                chosen = np.where(one.chosen < 0, one.chosen, np.append(near, NULL)[np.maximum(one.chosen, NULL)])
                after = _View(near, one.mean, one.cov)
                recalls = bool((~each.map.holds(chosen[chosen >= 0])).any())
                yield _Explanation(each.log_weight + one.log_density, each, chosen, view, after, recalls)

    def _differ(self, one: _Explanation, other: _Explanation) -> bool:
        """Whether two associations put a landmark at different positions relative to the robot.

        Nearby landmarks after the frame: beyond the smaller of the uncertainties; those known before: beyond their sum.
        """
        for mine, theirs, alone in ((one.after, other.after, True), (one.before, other.before, False)):
            _, a, b = np.intersect1d(mine.ids, theirs.ids, assume_unique=True, return_indices=True)
            covs = (mine.cov[a], theirs.cov[b]) if alone else (mine.cov[a] + theirs.cov[b],)
            apart = mine.mean[a] - theirs.mean[b]
            if any((squared_mahalanobis(apart, cov) > self.gates.accept).any() for cov in covs):
                return True
        return False
