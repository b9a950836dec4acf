"""Which landmark each measurement speaks of, and which measurements must be taken together.

Rows that speak of different landmarks are independent given the state; rows of one landmark that a particle sees
twice in a step (two cameras, two groups) are correlated through it and have to be stacked.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rbpf.core.models import NEW, NULL, Observations, Part
from rbpf.errors import InputError

STATE = frozenset({Part.STATE})
MAP = frozenset({Part.LANDMARK})
BOTH = STATE | MAP
"""What observations inform."""

Kinds = Callable[[np.ndarray], np.ndarray]
"""Numbers (K,) of the parametrisations of landmarks (K,), -1 where the map holds none."""


@dataclass(frozen=True)
class Row:
    """Measurement k of a group speaks of a landmark, in the particles of `mask` (N,); None is all."""

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


@dataclass
class Plan:
    """All rows of a step.

    Attributes:
        batches: independent rows of single-Gaussian landmarks.
        joint: rows that share a landmark.
        late: rows of landmarks with several components.
        log_factor: (N,) what new and clutter observations cost.
    """

    log_factor: np.ndarray
    batches: list[Batch] = field(default_factory=list)
    joint: list[list[Row]] = field(default_factory=list)
    late: list[Row] = field(default_factory=list)


def make_plan(groups: Sequence[Observations], n: int, kinds: Kinds, plain: np.ndarray) -> Plan:
    """Sorts the rows of all groups.

    Args:
        groups: observations that read a landmark.
        n: particles.
        kinds: tells of landmarks (K,) the numbers (K,) of their parametrisations, -1 where the map holds none.
        plain: (kinds,) whether that parametrisation has a single component.

    Raises:
        InputError: ids are missing, have a wrong shape, or name a landmark that the map does not hold.
    """
    plan = Plan(np.zeros(n))
    named = [_checked_ids(group, n, kinds) for group in groups]
    for group, ids in zip(groups, named, strict=True):
        for outcome, log_density in ((NEW, group.log_new), (NULL, group.log_clutter)):
            if log_density != 0.0:
                count = (ids == outcome).sum(axis=-1)
                plan.log_factor += np.where(count > 0, log_density, 0.0) * count
    if _are_simple(named, kinds, plain):
        chosen = [np.flatnonzero(ids >= 0) for ids in named]
        plan.batches = [Batch(number, ks, named[number][ks]) for number, ks in enumerate(chosen) if ks.size]
        return plan
    rows: dict[int, list[Row]] = {}
    for number, ids in enumerate(named):
        for row in _rows(number, ids):
            rows.setdefault(row.landmark, []).append(row)
    batches: dict[tuple[int, int], list[Row]] = {}
    for landmark, sightings in rows.items():
        kind = int(kinds(np.array([landmark]))[0])
        if not plain[kind]:
            plan.late.extend(sightings)
        elif _overlap(sightings):
            plan.joint.append(sightings)
        else:
            for row in sightings:
                batches.setdefault((row.group, kind), []).append(row)
    plan.batches = [_batch(sightings, n) for sightings in batches.values()]
    return plan


def _are_simple(named: Sequence[np.ndarray], kinds: Kinds, plain: np.ndarray) -> bool:
    """Whether all particles agree, no landmark is seen twice and each group's have one plain parametrisation."""
    seen = set[int]()
    for ids in named:
        if ids.ndim != 1:
            return False
        landmarks = [landmark for landmark in ids.tolist() if landmark >= 0]
        before = len(seen)
        seen.update(landmarks)
        if len(seen) < before + len(landmarks):
            return False
        of = kinds(np.array(landmarks, dtype=np.int64))
        if of.size and not (plain[of[0]] and (of == of[0]).all()):
            return False
    return True


def _checked_ids(group: Observations, n: int, kinds: Kinds) -> np.ndarray:
    ids, count = group.ids, group.z.shape[0]
    if ids is None:
        raise InputError(f"{type(group.model).__name__} reads a landmark: its observations need ids")
    if ids.shape not in ((count,), (n, count)):
        raise InputError(f"ids of {count} measurements must be ({count},) or ({n}, {count}), got {ids.shape}")
    if ids.dtype.kind != "i" or (ids.size and ids.min() < NEW):
        raise InputError(
            f"ids of {type(group.model).__name__} must be integers: landmarks, NULL = -1 or NEW = -2"
        )
    named = ids[ids >= 0]
    held = kinds(named) >= 0
    if not held.all():
        raise InputError(f"a measurement names landmark {named[~held][0]}, which the map does not hold")
    return ids


def _rows(number: int, ids: np.ndarray) -> list[Row]:
    if ids.ndim == 1:
        return [Row(number, k, landmark, None) for k, landmark in enumerate(ids.tolist()) if landmark >= 0]
    rows = []
    for k in range(ids.shape[1]):
        column = ids[:, k]
        first = int(column[0])
        if (column == first).all():
            if first >= 0:
                rows.append(Row(number, k, first, None))
            continue
        rows.extend(
            Row(number, k, int(landmark), column == landmark)
            for landmark in np.unique(column)
            if landmark >= 0
        )
    return rows


def _overlap(rows: list[Row]) -> bool:
    if len(rows) == 1:
        return False
    if any(row.mask is None for row in rows):
        return True
    return bool((np.sum([row.mask for row in rows if row.mask is not None], axis=0) > 1).any())


def _batch(rows: list[Row], n: int) -> Batch:
    ks = np.array([row.k for row in rows])
    ids = np.array([row.landmark for row in rows])
    if all(row.mask is None for row in rows):
        return Batch(rows[0].group, ks, ids)
    mask = np.array([np.ones(n, dtype=bool) if row.mask is None else row.mask for row in rows])
    return Batch(rows[0].group, ks, ids, np.ascontiguousarray(mask.T))


def by_use(groups: Sequence[Observations]) -> dict[frozenset[Part], list[Observations]]:
    """The groups by what they inform."""
    uses: dict[frozenset[Part], list[Observations]] = {STATE: [], BOTH: [], MAP: []}
    for group in groups:
        uses[group.updates].append(group)
    return uses


def require_apart(weigh: Sequence[Observations], both: Sequence[Observations]) -> None:
    """Rows of one landmark are correlated through it; those that do not update it cannot be stacked with others."""
    if not weigh or not both:
        return
    seen = [
        np.concatenate([np.ravel(group.ids) for group in part if group.ids is not None])
        for part in (weigh, both)
    ]
    shared = np.intersect1d(seen[0][seen[0] >= 0], seen[1])
    if shared.size:
        raise InputError(
            f"landmark {shared[0]} is observed by a group that updates the state alone and by one that updates both: "
            "split the second into one for each"
        )
