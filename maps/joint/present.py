"""The current sub-map of a joint map at the end of a window, and its exchange with finished sub-maps.

At the end of a window all particles are equal: landmarks are passed to finished sub-maps exactly, and return with all
information about them, Mathematics (passed-on).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from rbpf import gaussian
from rbpf.kernels.dense import principal
from rbpf.maps.joint.columns import JointColumns
from rbpf.maps.joint.rows import diagonal_blocks
from rbpf.maps.joint.solution import Given, SubMap
from rbpf.maps.joint.submaps import SubMaps


@dataclass
class Present:
    """The Gaussian of frame, substate, landmarks and clones; exchanges with finished sub-maps change it in place."""

    origin: np.ndarray  #: (E,) the frame's mean pose, relative to the sub-map's start.
    held: JointColumns  #: its landmarks and clones, and their columns.
    mean: np.ndarray  #: (n,).
    cov: np.ndarray  #: (n, n).
    given: np.ndarray  #: (K,) landmarks with a prior from finished sub-maps.
    walked: dict[int, np.ndarray]  #: covariance (D, D) of the landmarks' random walk in it, relative to its start.

    def finished(self, old: SubMaps) -> SubMap:
        """The sub-map, if it ended here."""
        points = self.held.table.ids[self.held.table.kind == 0]
        columns, given = self.held.of_one_kind(points).columns, np.intersect1d(self.given, points)
        d, constants = self.held.space.dim, self.constants(old)
        used = np.concatenate([np.arange(d), columns.ravel(), constants])
        return SubMap(
            self.origin,
            points,
            self.mean[columns],
            principal(self.cov, used),
            given=old.given(given, self.walked),
            constants=self.mean[constants],
        )

    def constants(self, old: SubMaps) -> np.ndarray:
        """Columns (k,) of the constants common to all sub-maps: the last ones of the substate."""
        return np.arange(self.held.first - old.about.constants.size, self.held.first)

    def pass_on(self, old: SubMaps, leaving: np.ndarray, wanted: np.ndarray | None, seen: Given | None = None) -> None:
        """Ends it, and starts the next one with all landmarks that are not `leaving`, unchanged.

        All sub-maps are solved jointly if distant landmarks are `wanted`. Old landmarks `seen` are added to the ended one.
        """
        held, d, constants = self.held, self.held.space.dim, self.constants(old)
        point, dim, driving = held.kinds[0], held.kinds[0].dim, held.first - d - constants.size
        seams = held.table.ids[held.table.ids < 0]
        # The driving substate ties the two like landmarks do: it is copied into pseudo-landmarks.
        count = -(-driving // dim)
        names = -1 - np.arange(count) - count * len(old.maps)
        taken = np.append(np.arange(self.mean.size), d + np.arange(driving))
        self.mean, self.cov = self.mean[taken], principal(self.cov, taken)
        if more := count * dim - driving:
            self.mean, self.cov = np.pad(self.mean, (0, more)), np.pad(self.cov, ((0, more), (0, more)))
            self.cov[-more:, -more:] = np.eye(more)
        held.add(names, point, np.full(count, -1), held.clones[:0])
        ended = self.finished(old)
        old.join(ended if seen is None else ended.seeing(seen), wanted is not None, wanted)
        columns = held.drop(held.rows_of(np.append(leaving, seams)))
        self.mean, self.cov = self.mean[columns], principal(self.cov, columns)
        self.origin, self.walked = held.space.identity(), {}
        self.mean[:d], self.cov[:d], self.cov[:, :d] = 0.0, 0.0, 0.0
        self.given = held.table.ids[held.table.kind == 0]
        if (known := old.given(self.given)) is not None:
            # The joint solution may know more of these, if landmarks were initialised again, or differ in second order.
            columns = np.append(held.of_one_kind(known.ids).columns, constants)
            own, off = principal(self.cov, columns), np.append(known.points, known.constants) - self.mean[columns]
            if off.any() or not np.array_equal(known.cov, own):  # usually they agree
                gain = np.linalg.solve(own, self.cov[columns]).T
                self.mean = self.mean + gain @ off
                self.cov = gaussian.symmetrise(self.cov + gain @ (known.cov - own) @ gain.T)

    def bring_in(self, old: SubMaps, returning: np.ndarray) -> None:
        """Adds old landmarks (K,) around the start to the current sub-map."""
        if returning.size:
            ended = self.finished(old)
            seen, slope, rest = old.brought_back(returning, ended)
            columns = np.append(np.arange(self.held.space.dim), self.held.of_one_kind(ended.ids).columns)
            columns = np.append(columns, self.constants(old))
            cross = slope @ self.cov[columns]
            self._hold(returning, seen)
            self.cov = np.block([[self.cov, cross.T], [cross, rest + cross[:, columns] @ slope.T]])

    def begin_again(self, old: SubMaps, seen: Given) -> None:
        """Ends it, and starts one at old landmarks observed from the frame, without odometry between the two.

        Only the substate is kept.
        """
        space, first, none = self.held.space, self.held.first, seen.ids[:0]
        old.join(self.finished(old))
        constants, given = old.known, old.given(none)
        cov = block_diag(np.eye(space.dim), constants.cov)
        sighting = SubMap(space.identity(), none, seen.points[:0], cov, False, given, constants.mean).seeing(seen)
        old.join(sighting, True, seen.ids)
        self.held, self.origin, self.given = JointColumns(space, first, self.held.kinds), space.identity(), none
        self.walked = {}
        self.mean, self.cov = self.mean[:first].copy(), self.cov[:first, :first].copy()
        self.mean[: space.dim], self.cov[: space.dim], self.cov[:, : space.dim] = 0.0, 0.0, 0.0
        # Landmarks and constants have the joint estimate of all sub-maps; the driving substate is in none of them.
        known, columns = old.given(seen.ids), self.constants(old)
        assert known is not None
        self._hold(seen.ids, known.points)
        self.mean[columns] = known.constants
        columns = np.append(first + np.arange(known.points.size), columns)
        self.cov = block_diag(self.cov, np.zeros((known.points.size, known.points.size)))
        self.cov[columns] = self.cov[:, columns] = 0.0
        self.cov[np.ix_(columns, columns)] = known.cov

    def _hold(self, ids: np.ndarray, points: np.ndarray) -> None:
        self.held.add(ids, self.held.kinds[0], np.full(ids.size, -1), self.held.clones[:0])
        self.mean, self.given = np.append(self.mean, points), np.union1d(self.given, ids)

    def landmarks(self, old: SubMaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Names (M,) of all landmarks, also of finished sub-maps, means (M, D) and covariances (M, D, D) in the world."""
        held, space, cov, origin = self.held, self.held.space, self.cov, self.origin
        d, dim, names, rays = space.dim, held.kinds[0].dim, held.table.ids, held.table.kind != 0
        if old.maps:
            ended = self.finished(old)
            whole = old.landmarks(ended)
            if not rays.any():
                return whole
            here, cov = old.end(ended), cov.copy()
            origin, cov[:d], cov[:, :d] = here.mean, 0.0, 0.0
            cov[:d, :d] = here.cov
        turn = space.rotation(origin)
        means, covs = np.empty((names.size, dim)), np.empty((names.size, dim, dim))
        for kind in held.by_kind():
            points, slope = held.points(kind, self.mean)
            # p = G Exp(ξ) l: ∂p/∂ξ = R [−[l]× | I], ∂p/∂l = R.
            columns = [np.broadcast_to(np.arange(d), (len(points), d)), kind.columns, kind.clones]
            blocks = diagonal_blocks(cov, np.concatenate(columns, axis=1))
            by_all = turn @ np.concatenate([space.transform_jacobian(points), slope], axis=-1)
            means[kind.rows] = space.transform(origin, points)
            covs[kind.rows] = gaussian.symmetrise(by_all @ blocks @ np.swapaxes(by_all, -1, -2))
        if old.maps:
            of_rays = names[rays], means[rays], covs[rays]
            names, means, covs = (np.concatenate(pair) for pair in zip(whole, of_rays, strict=True))
        return names.copy(), means, covs
