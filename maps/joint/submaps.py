"""Finished sub-maps of a joint map: independent Gaussians, tied by shared landmarks.

The cost of a step with one joint Gaussian is quadratic in its landmarks. A *sub-map* starts at the robot without prior and
ends when it is large; so sub-maps are independent, and each is one factor on its start, its end, and its landmarks. Their
joint information is sparse (S. Huang, Z. Wang and G. Dissanayake 2008, "Sparse local submap joining filter"). While the robot
explores, the last end and the landmarks around it suffice to continue: one Gaussian, to which a finished sub-map is joined at
constant cost (J. Tardós, J. Neira, P. Newman and J. Leonard 2002). When other landmarks are re-observed, all sub-maps are
solved jointly with new linearisation points, Mathematics (submaps). Sub-maps of the same place are fused, so that their
number grows with the area, not with time.
"""

from collections.abc import Callable, Mapping
from copy import copy
from types import MappingProxyType
from typing import NamedTuple, final

import numpy as np
from scipy.linalg import block_diag, cho_solve, solve_triangular

from rbpf import gaussian
from rbpf.core import checkpoint
from rbpf.core.models import RigidSpace
from rbpf.core.particles import Estimate
from rbpf.errors import InputError
from rbpf.kernels.dense import principal
from rbpf.lie import Array
from rbpf.maps.joint.columns import Beside
from rbpf.maps.joint.rows import plus_gram
from rbpf.maps.joint.solution import (
    EXACT,
    FORGOTTEN,
    ITERATIONS,
    NOTHING,
    Constants,
    Given,
    Solution,
    SubMap,
    exchanged,
    fused,
    inverse_of,
    loosened,
    moved,
    solve,
)

CLOSE_ENOUGH = 1e-6
"""Step [m, rad] below which the iterated update that ties two Gaussians has converged."""
ROUNDING = 1e-15
"""Variance [m²] of rounding errors."""
FIRM = 6
"""Least number of shared landmarks that tie two sub-maps without a common end and start."""


class _Tied(NamedTuple):
    """Start, landmarks `about` it, new end and landmarks: mean, covariance before the update, its decrease halfᵀ half.

    Landmarks about the start that are in the new map's prior are left out, as the new map has them; `mine` are rows it
    shares.
    """

    about: SubMap
    mean: np.ndarray
    cov: np.ndarray
    half: np.ndarray
    mine: np.ndarray


@final
class SubMaps:
    """The finished sub-maps, and their joint estimate around the start of the current one.

    Args:
        space: SE2, SE3 or Euclidean(n).
        dim: D, of a point.
        most: maximum number of landmarks kept around the current sub-map's start; those of the last one are always kept.
        unnamed: maintain `beside`, for unknown association.
        constants: prior of the constants (k,) common to all sub-maps.

    Attributes:
        frame: pose of the current one's end at the last `look_from`; None without finished ones.
        beside: the old landmarks there, if `unnamed`.
        maps: the finished sub-maps.
        starts: the world's origin, and world_from_end (E,) of each; the last one is the start of the current one.
        about: joint estimate of the last start, of landmarks around it, and of the constants, as a sub-map that starts at the
            world's origin and ends there.
    """

    def __init__(
        self, space: RigidSpace, dim: int, most: int, unnamed: bool = False, constants: Constants = NOTHING
    ) -> None:
        self.space, self.dim, self.most, self.unnamed, self.prior = space, dim, most, unnamed, constants
        self.frame: Estimate | None = None
        self.beside: Beside | None = None
        self.maps: list[SubMap] = []
        self.starts = [space.identity()]
        cov = block_diag(np.zeros((space.dim, space.dim)), constants.cov)
        self.about = SubMap(self.start, np.zeros(0, dtype=np.int64), np.zeros((0, dim)), cov, constants=constants.mean)
        self._places: tuple[np.ndarray, np.ndarray] | None = None
        self._factor_of_given: tuple[np.ndarray, ...] | None = None  # preceded by its inputs
        self._last: dict[int, tuple[int, int]] = {}  # last sub-map and row of each landmark

    @property
    def start(self) -> np.ndarray:
        """World_from_start (E,) of the current sub-map."""
        return self.starts[-1]

    @property
    def known(self) -> Constants:
        """The constants, estimated by all finished sub-maps."""
        own = slice(len(self.about.cov) - self.about.constants.size, None)
        return Constants(self.about.constants, self.about.cov[own, own])

    def presume(self, prior: Constants) -> None:
        """Replaces the constants' initial prior in all finished sub-maps."""
        (before, self.prior), d, k = (self.prior, prior), self.space.dim, prior.mean.size

        def anew(given: Given, first: int = 0) -> tuple[np.ndarray, Given]:
            own = slice(len(given.cov) - k, len(given.cov))
            mean = np.concatenate([np.zeros(first), given.points.ravel(), given.constants])
            mean, cov = exchanged(mean, given.cov, own, before, prior)
            points = mean[first : own.start].reshape(given.points.shape)
            return mean[:first], given._replace(points=points, cov=cov, constants=mean[own])

        def of(each: SubMap) -> SubMap:
            by, found = anew(Given(each.ids, each.points, each.cov, each.constants), d)
            end, cov = moved(self.space, each.end, by, found.cov)
            given = None if each.given is None else anew(each.given)[1]
            return SubMap(end, each.ids, found.points, cov, each.tied, given, found.constants)

        self.about, self.maps = of(self.about), [of(each) for each in self.maps]
        self.starts[-1], self._places = self.about.end, None

    def returned(self, ids: np.ndarray) -> np.ndarray:
        """Mask of landmarks (K,) that are in old sub-maps, but not among those around the start."""
        old = np.array([landmark in self._last for landmark in ids.tolist()], dtype=bool)
        return old & ~np.isin(ids, self.about.ids)

    def take(self, present: SubMap, is_large: bool) -> bool:
        """Joins the current sub-map if it is large, or if the robot has returned to old landmarks."""
        recall = False
        if self.unnamed and self.maps and present.ids.size:
            reach = float(np.linalg.norm(present.points, axis=1).max())
            recall = self.comes_near(self.end(present), reach)
        # Three landmarks determine a pose in space; with fewer the sub-map waits for more.
        if is_due := recall or is_large or bool(self.returned(present.ids).sum() >= 3):
            self.join(present, recall)
        return is_due

    def look_from(self, present: SubMap) -> None:
        """Updates `frame` and `beside` for the end of the current sub-map; both are constant between calls."""
        if not self.maps:
            return
        self.frame = self.end(present)
        if not self.unnamed:
            return
        # The old landmarks around the end of the current sub-map, by the joint estimate.
        about, x, cov, half, mine = tied = self._tied(present)
        own = slice(self.space.dim * 2 + self.dim * about.ids.size, len(x))
        others = np.setdiff1d(np.arange(about.ids.size), mine)
        seen, of_others = self._seen_from_end(tied, present, others)
        # Rows of the joint covariance, then regression on the current landmarks.
        rows, halves = of_others(cov), of_others(half.T)
        within = of_others(rows.T) - halves @ halves.T
        cross = rows[:, own] - halves @ half[:, own]
        spread = cov[own, own] - half[:, own].T @ half[:, own] + EXACT**2 * np.eye(own.stop - own.start)
        slope = cross @ inverse_of(gaussian.symmetrise(spread)) if present.ids.size else cross
        rest = gaussian.symmetrise(within - slope @ cross.T)
        self.beside = Beside(about.ids[others], seen, present.ids, present.points, slope, rest)

    def forget(self, ids: np.ndarray) -> None:
        """Removes landmarks (K,): they still tie the sub-maps, under internal names, but are no longer reported."""
        gone = np.array([name for name in ids.tolist() if name in self._last], dtype=np.int64)
        if not gone.size:
            return
        others = min(FORGOTTEN, *self._last) - 1 - np.arange(gone.size)

        def renamed(names: np.ndarray) -> np.ndarray:
            _, at, which = np.intersect1d(names, gone, return_indices=True)
            names = names.copy()
            names[at] = others[which]
            return names

        maps, self.maps, self._last, self._places = self.maps, [], {}, None
        for each in maps:
            given = None if each.given is None else each.given._replace(ids=renamed(each.inherited))
            self._hold(each._replace(ids=renamed(each.ids), given=given))
        self.about = self.about._replace(ids=renamed(self.about.ids))
        if self.beside is not None:
            self.beside = self.beside._replace(ids=renamed(self.beside.ids))

    def given(self, ids: np.ndarray, walked: Mapping[int, Array] = MappingProxyType({})) -> Given | None:
        """The prior by finished sub-maps of landmarks (K,) around the start, which may have `walked`, and of constants."""
        own, d = self.about.of(self.about.rows(ids)), self.space.dim
        if not (ids.size or own.constants.size):
            return None
        still = np.zeros((self.dim, self.dim))
        by = np.array([walked.get(name, still) for name in ids.tolist()]).reshape(-1, *still.shape)
        return Given(ids, own.points, own.cov[d:, d:], own.constants, by)

    def join(self, finished: SubMap, recall: bool = False, wanted: np.ndarray | None = None) -> None:
        """Adds a finished sub-map that starts at the last start; the next one starts at its end.

        All are solved jointly if landmarks have returned, or to `recall` those around the end and those `wanted`.
        """
        loop = recall or bool(self.returned(finished.ids).any())
        before = [self._last[name][0] for name in finished.ids.tolist() if name in self._last]
        self._take(finished)
        if loop:
            self.solve(wanted)
        if not finished.inherited.size and finished.tied and min(before, default=len(self.maps)) < len(self.maps) - 2:
            self._fuse()

    def end(self, present: SubMap) -> Estimate:
        """World_from_end of the current sub-map, by it and the estimate around its start."""
        mean, cov = self.end_and_constants(present)
        return Estimate(mean, cov[: self.space.dim, : self.space.dim])

    def end_and_constants(self, present: SubMap) -> tuple[np.ndarray, np.ndarray]:
        """Its mean (E,), and the covariance (d + k, d + k) of it and the constants."""
        space, d, k = self.space, self.space.dim, self.about.constants.size
        if present.given is not None and np.isin(present.ids, self.about.ids).sum() == present.inherited.size:
            # All shared landmarks are in its prior: only the start has to be updated.
            moved, by_new, rest = self._followed(present, np.arange(d))
            x, cross = np.append(moved, np.zeros(d)), by_new @ present.cov
            spread = rest + cross @ by_new.T
            theirs = np.append(np.arange(d), np.arange(len(present.cov) - k, len(present.cov)))
            cross = cross[:, theirs]
            own = np.block([[spread, cross], [cross.T, principal(present.cov, theirs)]])
        else:
            # Landmarks that only one of the two has do not affect the ends.
            both = copy(self)
            both.about = self.about.of(np.flatnonzero(np.isin(self.about.ids, present.ids)))
            about, x, cov, half, _ = both._tied(present.of(np.flatnonzero(np.isin(present.ids, self.about.ids))))
            ends = np.concatenate([np.arange(d), len(about.cov) + np.arange(d), np.arange(len(x) - k, len(x))])
            x, own = x[ends[: 2 * d]], cov[np.ix_(ends, ends)] - half[:, ends].T @ half[:, ends]
        end = space.retract(present.end, x[d:])
        by_start = space.adjoint(space.inverse(end)) @ space.right_jacobian(x[:d])
        turn = block_diag(np.concatenate([by_start, space.right_jacobian(x[d:])], axis=1), np.eye(k))
        mean = space.compose(space.retract(self.start, x[:d]), end)
        return mean, gaussian.symmetrise(turn @ own @ turn.T)

    def relative(self, number: int, present: SubMap) -> Estimate:
        """Pose of the current sub-map's end relative to that of an older one, by the joint estimate."""
        space, d, every = self.space, self.space.dim, self.copied()
        every._take(present)
        solution = every._solve(every._shared())
        cov = solution.eliminated.marginal(np.append(d * number + np.arange(d), d * len(self.maps) + np.arange(d)))
        mean = space.between(solution.starts[number + 1], solution.starts[-1])
        turn = np.concatenate([-space.adjoint(space.inverse(mean)), np.eye(d)], axis=1)
        return Estimate(mean, gaussian.symmetrise(turn @ cov @ turn.T))

    def _followed(self, new: SubMap, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Propagates a new sub-map's estimate of its prior landmarks and constants to these rows (R,) of `about.cov`.

        The new sub-map's estimate includes all previous information on them; the other rows follow by regression on the
        prior, Mathematics (passed-on). Returns the rows' shift (R,), their Jacobian by the new sub-map (R, d + MD + k), and
        their remaining covariance given it.
        """
        space, d, dim = self.space, self.space.dim, self.dim
        by_new = np.zeros((rows.size, len(new.cov)))
        if new.given is None:
            return np.zeros(rows.size), by_new, self.about.cov[np.ix_(rows, rows)]
        _, mine, its = np.intersect1d(self.about.ids, new.inherited, assume_unique=True, return_indices=True)
        columns = self.about.columns(mine)[d:]
        held, walked = self._factor_of_given, new.given.walked[its] + ROUNDING * np.eye(dim)
        if held is None or held[0] is not self.about.cov or not all(map(np.array_equal, held[1:3], (columns, walked))):
            own = loosened(principal(self.about.cov, columns), 0, walked)
            self._factor_of_given = held = self.about.cov, columns, walked, gaussian.cholesky(own).T
        cross = self.about.cov[np.ix_(columns, rows)]
        gain = cho_solve((held[3], False), cross, check_finite=False).T
        theirs = new.rows(new.inherited[its])
        seen, of_points, last = new.points[theirs], gain[:, : mine.size * dim], gain[:, mine.size * dim :]
        by_points = (of_points.reshape(rows.size, mine.size, dim) @ space.rotation(new.end)).reshape(rows.size, -1)
        by_new[:, new.columns(theirs)[d:]] = np.concatenate([by_points, last], axis=1)
        by_new[:, :d] = by_points @ space.transform_jacobian(seen).reshape(-1, d)
        off = space.transform(new.end, seen) - self.about.points[mine]
        moved = gain @ np.append(off, new.constants - self.about.constants)
        return moved, by_new, self.about.cov[np.ix_(rows, rows)] - gain @ cross

    def brought_back(self, ids: np.ndarray, present: SubMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Landmarks (K,) around the start, relative to the end of the current sub-map (K, D).

        Also their Jacobian (KD, d + MD + k) by its end, points and constants, and their remaining covariance given these.
        """
        space, d, dim = self.space, self.space.dim, self.dim
        at = self.about.rows(ids)
        moved, by_new, rest = self._followed(present, (d + dim * at[:, None] + np.arange(dim)).ravel())
        seen = space.inverse_transform(present.end, self.about.points[at] + moved.reshape(-1, dim))
        turn = np.kron(np.eye(at.size), space.rotation(present.end).T)
        slope = turn @ by_new
        slope[:, :d] -= space.transform_jacobian(seen).reshape(-1, d)
        return seen, slope, turn @ gaussian.symmetrise(rest) @ turn.T

    def _seen_from_end(
        self, tied: _Tied, new: SubMap, others: np.ndarray
    ) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Landmarks around the start, by row (K,), relative to the end of a new sub-map (K, D).

        Also a function that maps rows (n, …) of the tied Gaussian to theirs (KD, …).
        """
        space, d, dim = self.space, self.space.dim, self.dim
        turned = slice(len(tied.about.cov), len(tied.about.cov) + d)
        end, theirs = space.retract(new.end, tied.mean[turned]), d + dim * others[:, None] + np.arange(dim)
        seen = space.inverse_transform(end, tied.mean[theirs])
        by_end = -space.transform_jacobian(seen) @ space.right_jacobian(tied.mean[turned])
        back = space.rotation(end).T

        def of_others(rows: np.ndarray) -> np.ndarray:
            return (back @ rows[theirs] + by_end @ rows[turned]).reshape(theirs.size, rows.shape[1])

        return seen, of_others

    def comes_near(self, end: Estimate, reach: float) -> bool:
        """Whether an old landmark other than those around the start may be within reach of a pose."""
        origin = np.zeros((1, self.dim))
        off = self.space.transform(end.mean, origin) - self.space.transform(self.start, origin)
        ids = np.setdiff1d(self.ids, self.about.ids)
        if np.linalg.norm(off) < 0.5 * reach or not ids.size:
            return False
        at = self.space.dim - self.dim
        reach += 3.0 * float(np.sqrt(np.linalg.eigvalsh(end.cov[at:, at:])[-1]))
        far = np.linalg.norm(self.space.inverse_transform(end.mean, self.guess(ids)), axis=1)
        return bool((far < reach).any())

    def __deepcopy__(self, memo: dict[int, object]) -> "SubMaps":
        return self.copied()

    @property
    def ids(self) -> np.ndarray:
        """Names of all landmarks (M,)."""
        return np.array([name for name in self._last if name >= 0], dtype=np.int64)

    def copied(self) -> "SubMaps":
        """A copy, so that queries of the joint solution do not change this object."""
        other = copy(self)
        other.maps, other.starts, other._last = list(self.maps), list(self.starts), dict(self._last)
        return other

    def landmarks(self, present: SubMap | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Names (M,), world positions (M, D) and covariances (M, D, D), by all sub-maps and the current one.

        Starts and shared landmarks are solved jointly; the others follow from their own sub-map, given these.
        """
        if present is not None and present.ids.size:
            every = self.copied()
            every._take(present)
            return every.landmarks()
        space, d, dim = self.space, self.space.dim, self.dim
        solution = self._solve(self._shared())
        joint, end_of = solution.eliminated.within(), solution.starts[1:]
        names, places, covs = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        for number, (each, factor) in enumerate(zip(self.maps, solution.factors, strict=True)):
            # Landmarks whose last sub-map this is, conditioned on those solved for and its start and end.
            mine = np.flatnonzero([name >= 0 and self._last[name][0] == number for name in each.ids.tolist()])
            if not mine.size:
                continue
            theirs = d + dim * mine[:, None] + np.arange(dim)
            gain = each.cov[np.ix_(theirs.ravel(), factor.own)] @ factor.info
            cross = each.cov[np.ix_(factor.own, theirs.ravel())]
            rest = each.cov[theirs[:, :, None], theirs[:, None]]
            rest = rest - np.einsum("mik,kmj->mij", gain.reshape(mine.size, dim, -1), cross.reshape(-1, mine.size, dim))
            seen = each.points[mine] + (gain @ factor.residual).reshape(-1, dim)
            by_all = factor.through(gain).reshape(mine.size, dim, -1)
            by_all[:, :, d : 2 * d] += space.transform_jacobian(seen)
            by_all = by_all[:, :, factor.columns >= 0]
            half = (by_all.reshape(-1, by_all.shape[2]) @ joint[number]).reshape(by_all.shape)
            spread = half @ np.swapaxes(by_all, 1, 2)
            turn = space.rotation(end_of[number])
            names.append(each.ids[mine])
            places.append(space.transform(end_of[number], seen))
            covs.append(turn @ (rest + spread) @ turn.T)
        return np.concatenate(names), np.concatenate(places), gaussian.symmetrise(np.concatenate(covs))

    def _tied(self, new: SubMap) -> _Tied:
        """Ties the Gaussians around the last start and the new end by an iterated noise-free update on shared landmarks."""
        space, d, dim = self.space, self.space.dim, self.dim
        left = np.flatnonzero(~np.isin(self.about.ids, new.inherited))
        about = self.about.of(left)
        _, mine, its = np.intersect1d(about.ids, new.ids, assume_unique=True, return_indices=True)
        first = len(about.cov)
        size = first + len(new.cov)
        cov = block_diag(about.cov, new.cov)
        prior = np.append(about.mean, new.mean)
        of_mine = d + dim * mine[:, None] + np.arange(dim)
        of_its = first + d + dim * its[:, None] + np.arange(dim)
        if new.given is not None:
            moved, by_new, rest = self._followed(new, self.about.columns(left))
            prior[:first] += moved
            cov[:first, first:] = cross = by_new @ new.cov
            cov[first:, :first], cov[:first, :first] = cross.T, gaussian.symmetrise(rest + cross @ by_new.T)
        x, half, turned = prior, np.zeros((0, size)), slice(first, first + d)
        for _ in range(ITERATIONS if of_mine.size else 0):
            # 0 = l − E Exp(ε) l′ for each shared landmark, l′ in the new sub-map, whose end is E Exp(ε).
            end, seen = space.retract(new.end, x[turned]), x[of_its]
            rotation = space.rotation(end)
            by_turned = rotation @ space.transform_jacobian(seen) @ space.right_jacobian(x[turned])

            def moved_by(columns: np.ndarray, rotation: Array = rotation, by: Array = by_turned) -> Array:
                off = columns[of_mine] - rotation @ columns[of_its] - by @ columns[turned]
                return off.reshape(-1, columns.shape[1])

            slope = moved_by(cov)
            chol = gaussian.cholesky(gaussian.symmetrise(moved_by(slope.T)))
            half = solve_triangular(chol, slope, lower=True, check_finite=False)
            off = (x[of_mine] - space.transform(end, seen)).ravel() + moved_by((prior - x)[:, None])[:, 0]
            moved = prior - half.T @ solve_triangular(chol, off, lower=True, check_finite=False)
            step, x = np.abs(moved - x).max(), moved
            if step < CLOSE_ENOUGH:
                break
        return _Tied(about, x, cov, half, mine)

    def _take(self, new: SubMap) -> None:
        """Moves `about` to its end: the end, its landmarks, and further old ones, up to `most`."""
        space, d, dim = self.space, self.space.dim, self.dim
        about, x, cov, half, mine = tied = self._tied(new)
        first, k = len(about.cov), about.constants.size
        turned, points = slice(first, first + d), slice(first + d, len(x) - k)
        start, end = space.retract(self.start, x[:d]), space.retract(new.end, x[turned])
        by_start = space.adjoint(space.inverse(end)) @ space.right_jacobian(x[:d])
        by_end = space.right_jacobian(x[turned])
        others = np.setdiff1d(np.arange(about.ids.size), mine)
        far = np.linalg.norm(self._seen_from_end(tied, new, others)[0], axis=1)
        kept = np.sort(np.argsort(far, kind="stable")[: max(self.most - new.ids.size, 0)])
        others = others[kept[about.ids[others[kept]] >= 0]]
        seen, of_others = self._seen_from_end(tied, new, others)

        def of_moved(rows: np.ndarray) -> np.ndarray:
            return np.concatenate([by_start @ rows[:d] + by_end @ rows[turned], of_others(rows)])

        # The new map's landmarks and the constants keep their coordinates; the rest is transformed.
        theirs = d + dim * others[:, None] + np.arange(dim)
        columns = np.concatenate([np.arange(first, points.stop), theirs.ravel(), np.arange(points.stop, len(x))])
        own = np.append(np.arange(d), points.stop - first + np.arange(theirs.size))
        cov = plus_gram(cov, half, -1.0)
        moved, cov = of_moved(cov), principal(cov, columns)
        cov[own] = moved[:, columns]
        cov[:, own] = cov[own].T
        cov[np.ix_(own, own)] = gaussian.symmetrise(of_moved(moved.T))
        self.starts[-1:] = [start, space.compose(start, end)]
        self.about = self.about._replace(
            end=self.start,
            ids=np.append(new.ids, about.ids[others]),
            points=np.concatenate([x[points].reshape(-1, dim), seen]),
            cov=cov,
            constants=x[len(x) - k :],
        )
        self._places = None
        self._hold(new)

    def _hold(self, new: SubMap) -> None:
        self._last |= {landmark: (len(self.maps), row) for row, landmark in enumerate(new.ids.tolist())}
        self.maps.append(new)

    def _fuse(self) -> None:
        """Fuses older sub-maps of the same place into the last one, so that their number does not grow on repeated visits.

        This drops an older one's ties to its neighbours in time, except by shared landmarks: about one odometry step of
        information each. No fusion if too few landmarks are shared, and never of the first sub-map.
        """
        for number in range(len(self.maps) - 3, 0, -1):
            old, new = self.maps[number], self.maps[-1]
            common = int(np.isin(old.ids, new.ids).sum())
            if (
                common < max(FIRM, 0.5 * min(old.ids.size, new.ids.size))
                or old.ids.size + new.ids.size - common > self.most
            ):
                continue
            # The neighbours in time that would lose their tie to the old one.
            beside = [self.maps[number - 1]] if old.tied else []
            beside += [each for each in [self.maps[number + 1]] if each.tied]
            both = np.union1d(old.ids, new.ids)
            if any(np.isin(each.ids, both).sum() < FIRM for each in beside):
                continue
            self.maps[-1] = fused(self.space, new, old, self.space.between(self.start, self.starts[number + 1]))
            del self.maps[number], self.starts[number + 1]
            self.maps[number] = self.maps[number]._replace(tied=False)
            held, self.maps, self._last = self.maps, [], {}
            for each in held:
                self._hold(each)

    def _shared(self, asked: np.ndarray | None = None) -> np.ndarray:
        """Landmarks in several sub-maps; with `asked` (K,) also those, and all that may be kept around the end."""
        ids, times = np.unique(np.concatenate([each.ids for each in self.maps]), return_counts=True)
        wanted, last = times > 1, self.maps[-1].ids
        if asked is not None:
            wanted |= np.isin(ids, last) | np.isin(ids, asked)
            far = np.linalg.norm(self.space.inverse_transform(self.start, self.guess(ids)), axis=1)
            order = np.lexsort((far, -self._co_observed(ids, asked)))
            wanted[order[: max(self.most - last.size, 0)]] = True
        return ids[wanted]

    def _co_observed(self, ids: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """For each landmark (K,) the most `asked` ones in a sub-map with it: those seen together are likely seen next."""
        most = np.zeros(ids.size, dtype=np.int64)
        for each in self.maps:
            most = np.maximum(most, np.isin(ids, each.ids) * np.isin(asked, each.ids).sum())
        return most

    def guess(self, ids: np.ndarray) -> np.ndarray:
        """World positions (K, D) of landmarks (K,), by the last sub-map of each."""
        held = np.array([self._last[landmark] for landmark in ids.tolist()], dtype=np.int64).reshape(-1, 2)
        ends = np.array([self.starts[number + 1] for number in held[:, 0]]).reshape(-1, self.space.size)
        points = np.array([self.maps[number].points[row] for number, row in held]).reshape(-1, self.dim)
        return self.space.transform(ends, points)

    def latest(self) -> tuple[np.ndarray, np.ndarray]:
        """Names (M,) of all landmarks, and the number (M,) of each one's last sub-map."""
        held = [(name, number) for name, (number, _) in self._last.items() if name >= 0]
        names, numbers = np.array(held, dtype=np.int64).reshape(-1, 2).T
        return names, numbers

    def surely_near(self, ratio: float) -> np.ndarray:
        """Names (K,) of landmarks around the start whose standard deviation is below this fraction of their distance."""
        columns = self.space.dim + self.dim * np.arange(self.about.ids.size)[:, None] + np.arange(self.dim)
        variance = np.diagonal(self.about.cov)[columns].max(axis=1, initial=0.0)
        return self.about.ids[np.sqrt(variance) <= ratio * np.linalg.norm(self.about.points, axis=1)]

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Names (M,) of all landmarks, and their world positions (M, D) by the last sub-map of each; cached."""
        if self._places is None:
            self._places = self.ids, self.guess(self.ids)
        return self._places

    def _solve(self, ids: np.ndarray) -> Solution:
        return solve(self.space, self.maps, ids, np.array(self.starts), self.guess(ids), self.about.constants)

    def solve(self, wanted: np.ndarray | None = None) -> None:
        """Solves all jointly with new linearisation points; updates the starts and `about`, with landmarks `wanted`."""
        asked = np.zeros(0, dtype=np.int64) if wanted is None else wanted
        try:
            solution = self._solve(self._shared(asked))
        except InputError:  # the filter has diverged: no change
            return
        if not solution.is_whole:
            return
        ids, self.starts, self._places = solution.ids, list(solution.starts), None
        seen = self.space.inverse_transform(self.start, solution.world)
        last = np.isin(ids, self.maps[-1].ids) | np.isin(ids, asked)
        far = np.where(last, -1.0, np.linalg.norm(seen, axis=1))
        order = np.lexsort((far, -self._co_observed(ids, asked), ~last))
        kept = order[: max(self.most, int(last.sum()))]
        kept = kept[last[kept] | (ids[kept] >= 0)]
        points, cov = solution.seen_from(self.space, len(self.maps), kept)
        self.about = self.about._replace(
            end=self.start, ids=ids[kept], points=points, cov=cov, constants=solution.constants
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a checkpoint."""
        named, walked = {"submaps/starts": np.array(self.starts)}, np.zeros((0, self.dim, self.dim))
        nothing = Given(np.zeros(0, dtype=np.int64), walked[:, 0], np.zeros((0, 0)), walked=walked)
        for number, each in enumerate([self.about, *self.maps]):
            own, given = each._asdict(), each.given or nothing
            own |= {"tied": np.array(each.tied)} | {f"given_{name}": array for name, array in given._asdict().items()}
            del own["given"]
            named |= {f"submaps/{number}/{name}": array for name, array in own.items()}
        if self.frame is not None:
            named |= {"joint/frame": self.frame.mean, "joint/frame_cov": self.frame.cov}
        if self.beside is not None:
            named |= {f"joint/beside/{name}": array for name, array in self.beside._asdict().items()}
        return named

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`. Raises InputError: they are damaged."""
        d, dim, k = self.space.dim, self.dim, self.known.mean.size
        self.starts = list(checkpoint.read_one(arrays, "submaps/starts", checkpoint.elements(self.space, "starts")))
        maps = list[SubMap]()
        if not self.starts or f"submaps/{len(self.starts)}/end" in arrays:
            raise InputError("the array submaps/starts does not have one more than there are sub-maps")
        for number in range(len(self.starts)):
            schema = {
                "end": checkpoint.elements(self.space), "ids": checkpoint.integers("landmarks", distinct=True),
                "points": checkpoint.numbers("landmarks", dim), "cov": checkpoint.numbers("size", "size"),
                "tied": checkpoint.truths(), "constants": checkpoint.numbers(k),
                "given_ids": checkpoint.integers("given", refers=f"submaps/{number}/ids"),
                "given_points": checkpoint.numbers("given", dim), "given_cov": checkpoint.numbers("entries", "entries"),
                "given_constants": checkpoint.numbers(k if number else 0),
                "given_walked": checkpoint.numbers("given", dim, dim),
            }  # fmt: skip
            found = checkpoint.read(arrays, schema, f"submaps/{number}/")
            end, ids, points, cov, tied, constants, *given = found.values()
            if len(cov) != d + points.size + k or len(given[2]) != given[1].size + given[3].size:
                raise InputError(f"the arrays submaps/{number}/cov and given_cov do not fit the landmarks")
            own = Given(*given) if len(given[2]) else None
            maps.append(SubMap(end, ids, points, cov, bool(tied), own, constants))
        self.about, self.maps, self._last = maps[0], [], {}
        for each in maps[1:]:
            self._hold(each)
        if not np.isin(self.about.ids, list(self._last)).all():
            raise InputError("the array submaps/0/ids has a landmark that is in no sub-map")
        if not self.maps:
            return
        schema = {"frame": checkpoint.elements(self.space), "frame_cov": checkpoint.numbers(d, d)}
        found = checkpoint.read(arrays, schema, "joint/")
        self.frame = Estimate(found["frame"], found["frame_cov"])
        if self.unnamed:
            self.beside = Beside.restored(arrays, self.dim)
