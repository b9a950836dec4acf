"""Landmarks and clones of a joint map and their columns in its Gaussian; and old landmarks beside them."""

from collections.abc import Mapping
from copy import copy
from typing import NamedTuple

import numpy as np

from rbpf.core import checkpoint
from rbpf.core.models import FusedKernel, Landmark, ObservationModel, Part, RigidSpace
from rbpf.errors import InputError
from rbpf.lie import Array, SE3Group
from rbpf.maps.rows import fused_kernel


class Table(NamedTuple):
    """Table of landmarks (M,): names, numbers of kinds, first columns, and rows of their anchor clones."""

    ids: np.ndarray
    kind: np.ndarray
    first: np.ndarray
    clone: np.ndarray  #: −1 if not anchored.


class Kind(NamedTuple):
    """Landmarks of one kind, K of them, as rows of the table (K,)."""

    landmark: Landmark
    rows: np.ndarray
    columns: np.ndarray  #: (K, D) of their means.
    clones: np.ndarray  #: (K, d) columns of their anchor clones; (K, 0) if not anchored.
    origins: np.ndarray  #: (K, E) linearisation points of these clones; (K, 0) if none.


class JointColumns:
    """Index of landmarks by name and by kind.

    Args:
        space: space of the clones, which have d columns each.
        first: number of columns before landmarks and clones: the frame's pose and the substate.
        kinds: the parametrisations, by their numbers.

    Attributes:
        size: n, total number of columns.
        table: the landmarks; replaced by `hold`.
        clones: (C, E) linearisation points K of the clones.
        clone_first: (C,) their first columns.
    """

    def __init__(self, space: RigidSpace, first: int, kinds: list[Landmark]) -> None:
        none = np.zeros(0, dtype=np.int64)
        self.space, self.first, self.kinds = space, first, kinds
        self.size, self.clones, self.clone_first = first, np.zeros((0, space.size)), none
        self.hold(Table(none, none, none, none))

    def add(self, ids: np.ndarray, landmark: Landmark, clone: np.ndarray, origins: np.ndarray) -> np.ndarray:
        """Appends new clones (C, E), then landmarks (K,), each anchored at a clone by its row, or −1.

        Returns their columns (K, D).
        """
        first = self.size + self.space.dim * len(origins) + landmark.dim * np.arange(ids.size)
        clone = np.where(clone < 0, -1, clone + len(self.clones))
        self.clone_first = np.append(self.clone_first, self.size + self.space.dim * np.arange(len(origins)))
        self.clones = np.concatenate([self.clones, origins])
        self.size += self.space.dim * len(origins) + landmark.dim * ids.size
        new = Table(ids, np.full(ids.size, self.number(landmark)), first, clone)
        self.hold(Table(*(np.concatenate(pair) for pair in zip(self.table, new, strict=True))))
        return first[:, None] + np.arange(landmark.dim)

    def drop(self, rows: np.ndarray) -> np.ndarray:
        """Drops landmarks by row, and clones without anchored landmarks; returns the columns that are kept."""
        gone = np.isin(np.arange(self.table.ids.size), rows)
        columns = [kind.columns[gone[kind.rows]].ravel() for kind in self.by_kind()]
        table = Table(*(column[~gone] for column in self.table))
        used = np.isin(np.arange(len(self.clones)), table.clone)
        kept = np.ones(self.size, dtype=bool)
        kept[np.concatenate([*columns, self.clone_columns(np.flatnonzero(~used)).ravel()])] = False
        place, number = np.cumsum(kept) - 1, np.append(np.cumsum(used) - 1, -1)
        self.clones, self.clone_first = self.clones[used], place[self.clone_first[used]]
        self.hold(table._replace(first=place[table.first], clone=number[table.clone]))
        self.size = int(kept.sum())
        return np.flatnonzero(kept)

    def hold(self, table: Table) -> None:
        self.table = table
        self._row_of = {landmark: row for row, landmark in enumerate(table.ids.tolist())}

    def holds(self, ids: np.ndarray) -> np.ndarray:
        """Mask of the landmarks (K,) in the table."""
        return np.array([landmark in self._row_of for landmark in np.asarray(ids).tolist()], dtype=bool)

    def rows_of(self, ids: np.ndarray) -> np.ndarray:
        """Rows (K,) of landmarks in the table. Raises InputError: one of them is not in the map."""
        try:
            return np.array([self._row_of[landmark] for landmark in np.asarray(ids).tolist()], dtype=np.int64)
        except KeyError as error:
            raise InputError(f"the map has no landmark {error.args[0]}") from error

    def number(self, landmark: Landmark) -> int:
        """Number of a parametrisation; −1 if it is unknown to the map."""
        return self.kinds.index(landmark) if landmark in self.kinds else -1

    def of_one_kind(self, ids: np.ndarray) -> Kind:
        """Landmarks (K,) of one kind, in their order. Raises InputError: one is not in the map, or kinds differ."""
        rows = self.rows_of(ids)
        kinds = self.table.kind[rows]
        if (kinds != kinds[:1]).any():
            raise InputError("a joint map reads landmarks of one parametrisation at a time: see `landmark_of`")
        return self._of_kind(int(kinds[0]) if kinds.size else 0, rows)

    def by_kind(self) -> list[Kind]:
        """All landmarks, grouped by kind."""
        numbers = np.unique(self.table.kind).tolist()
        return [self._of_kind(number, np.flatnonzero(self.table.kind == number)) for number in numbers]

    def clone_columns(self, clones: np.ndarray) -> np.ndarray:
        """Columns (K, d) of clones (K,)."""
        return self.clone_first[clones, None] + np.arange(self.space.dim)

    def poses(self, kind: Kind, mean: np.ndarray) -> np.ndarray:
        """Anchor poses (…, K, E) of anchored landmarks in the frame, from means (…, n)."""
        return self.space.retract(kind.origins, mean[..., kind.clones])

    def kernel(self, model: ObservationModel, kind: Kind | None) -> FusedKernel | None:
        """The model's kernel for a kind of landmark, if `linearise_group` supports its anchoring."""
        if kind is None or (Part.SUBSTATE in model.reads and model.about is None):
            return None
        return fused_kernel(model) if not kind.landmark.anchored or isinstance(self.space, SE3Group) else None

    def points(self, kind: Kind, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks as points (…, K, dim) in the frame, from means (…, n), and their Jacobian by their columns and clones."""
        if not kind.landmark.anchored:
            return kind.landmark.point(mean[..., kind.columns])
        anchor = self.poses(kind, mean)
        points, slope = kind.landmark.point(mean[..., kind.columns], anchor)
        # p = K Exp(δ) l: ∂p/∂δ = R [−[l]× | I] J_r.
        near = self.space.inverse_transform(anchor, points)
        by_clone = self.space.rotation(anchor) @ self.space.transform_jacobian(near)
        return points, np.concatenate([slope, by_clone @ self.space.right_jacobian(mean[..., kind.clones])], axis=-1)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        return {"clones": self.clones, "clone_first": self.clone_first, **self.table._asdict()}

    def restore(self, arrays: dict[str, np.ndarray], prefix: str, size: int) -> None:
        """The inverse of `arrays`, for n columns. Raises InputError: they are damaged."""
        rows, kinds = checkpoint.integers("landmarks", least=0), len(self.kinds)
        schema = {
            "ids": checkpoint.integers("landmarks"), "first": rows,
            "kind": checkpoint.integers("landmarks", least=0, below=kinds),
            "clones": checkpoint.elements(self.space, "clones"), "clone_first": checkpoint.integers("clones", least=0),
            "clone": checkpoint.integers("landmarks", least=-1, below="clones"),
        }  # fmt: skip
        found = checkpoint.read(arrays, schema, prefix)
        table, self.size = Table(*(found[name] for name in Table._fields)), size
        anchored = np.array([kind.anchored for kind in self.kinds])[table.kind]
        if ((table.clone >= 0) != anchored).any():
            raise InputError(f"the array {prefix}clone does not fit the landmarks' kinds")
        self.clones, self.clone_first = found["clones"], found["clone_first"]
        self.hold(table)
        own = [kind.columns.ravel() for kind in self.by_kind()]
        own.append(self.clone_columns(np.arange(len(self.clones))).ravel())
        if not np.array_equal(np.sort(np.concatenate(own)), np.arange(self.first, size)):
            raise InputError(
                f"the arrays {prefix}first and {prefix}clone_first do not share the columns of {prefix}mean out"
            )

    def _of_kind(self, number: int, rows: np.ndarray) -> Kind:
        landmark, clones = self.kinds[number], self.table.clone[rows]
        columns = self.table.first[rows, None] + np.arange(landmark.dim)
        if not landmark.anchored:
            return Kind(landmark, rows, columns, np.zeros((rows.size, 0), dtype=np.int64), np.zeros((rows.size, 0)))
        return Kind(landmark, rows, columns, self.clone_columns(clones), self.clones[clones])


class Beside(NamedTuple):
    """Old landmarks (K,) that are not in the current sub-map, at `points` (K, D) relative to its end.

    The current sub-map's landmarks (M,) are at `theirs` (M, D). The old ones depend on them by regression: Jacobian `slope`
    (KD, MD) and remaining covariance `rest` (KD, KD).
    """

    ids: np.ndarray
    points: np.ndarray
    own: np.ndarray
    theirs: np.ndarray
    slope: np.ndarray
    rest: np.ndarray

    def widened(self, held: JointColumns, mean: np.ndarray, cov: Array) -> tuple[JointColumns, np.ndarray, Array]:
        """Columns, means (N, n) and covariance (n, n) of the current sub-map, extended by these old landmarks."""
        own, new, dim = held.holds(self.own), ~held.holds(self.ids) & (self.ids >= 0), self.points.shape[1]
        columns = held.of_one_kind(self.own[own]).columns.ravel()
        at, rows = np.repeat(own, dim), np.repeat(new, dim)
        slope, rest = self.slope[np.ix_(rows, at)], self.rest[np.ix_(rows, rows)]
        moved, cross = mean[:, columns] - self.theirs[own].ravel(), slope @ cov[columns]
        wide = copy(held)
        wide.add(self.ids[new], held.kinds[0], np.full(int(new.sum()), -1), held.clones[:0])
        mean = np.concatenate([mean, self.points[new].ravel() + moved @ slope.T], axis=1)
        return wide, mean, np.block([[cov, cross.T], [cross, rest + cross[:, columns] @ slope.T]])

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray], dim: int) -> "Beside":
        """From a checkpoint, D numbers per landmark. Raises InputError: it is damaged."""
        schema = {
            "ids": checkpoint.integers("others", least=0), "points": checkpoint.numbers("others", dim),
            "own": checkpoint.integers("own", least=0), "theirs": checkpoint.numbers("own", dim),
            "slope": checkpoint.numbers("rows", "columns"), "rest": checkpoint.numbers("rows", "rows"),
        }  # fmt: skip
        found = cls(**checkpoint.read(arrays, schema, "joint/beside/"))
        if found.slope.shape != (found.points.size, found.theirs.size):
            raise InputError("the array joint/beside/slope does not fit its landmarks")
        return found
