"""Joint solution of finished sub-maps: all starts and landmarks by Gauss-Newton, Mathematics (submaps)."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, block_diag

from rbpf import gaussian
from rbpf.core.models import RigidSpace
from rbpf.errors import InputError
from rbpf.kernels.dense import principal
from rbpf.maps.joint.elimination import Elimination, cliques_of

ENOUGH, ITERATIONS = 0.1, 20
"""Norm of the last Gauss-Newton step, in standard deviations of the joint solution, and maximum number of steps."""
LESS = {1.0: 0.99, 0.99: 0.9, 0.9: 0.0}
"""The next smaller fraction of the sub-maps' priors to subtract if the difference is not positive definite."""
FORGOTTEN = -(2**40)
"""Smaller names are those of landmarks that have been removed."""
EXACT, AT_REST = 1e-5, 1e-7
"""Standard deviations [m, rad] added to the driving substate if it is known exactly, and to the end of a robot at rest.

The relative accuracy of landmarks is some micrometres, in comparison to which these must be negligible.
"""


class Given(NamedTuple):
    """The prior given to a sub-map: landmarks (K,) at `points` (K, D) relative to its start, and `constants` (k,).

    `cov` is the joint covariance (KD + k, KD + k); `walked` (K, D, D) is the landmarks' random walk since then.
    """

    ids: np.ndarray
    points: np.ndarray
    cov: np.ndarray
    constants: np.ndarray = np.zeros(0)
    walked: np.ndarray = np.zeros((0, 0, 0))


class Constants(NamedTuple):
    """Constants common to all sub-maps, Mathematics (submap-constants): mean (k,) and covariance (k, k)."""

    mean: np.ndarray
    cov: np.ndarray


NOTHING = Constants(np.zeros(0), np.zeros((0, 0)))


def exchanged(
    mean: np.ndarray, cov: np.ndarray, own: slice, before: Constants, after: Constants
) -> tuple[np.ndarray, np.ndarray]:
    """Replaces the prior `before` of a Gaussian's constants `own` by `after`; mean (…, n), cov (n, n): Mathematics (exchange).

    Spurious shifts by sampled paths, along directions without information, are ignored.
    """
    here, unit = inverse_of(cov[own, own]), gaussian.cholesky(after.cov)
    values, vectors = np.linalg.eigh(unit.T @ (here - inverse_of(before.cov)) @ unit)
    told = np.linalg.solve(unit.T, vectors[:, values > 0.0])
    told = (told * values[values > 0.0]) @ told.T
    spread = inverse_of(gaussian.symmetrise(told + inverse_of(after.cov)))
    centre = (mean[own] if mean.ndim == 1 else mean[0, own]) - before.mean
    by_told = before.mean + np.linalg.lstsq(told, here @ centre)[0]
    found = after.mean + spread @ told @ (by_told - after.mean)
    slope = np.linalg.solve(cov[own, own], cov[own]).T
    cov = gaussian.symmetrise(cov + slope @ (spread - cov[own, own]) @ slope.T)
    return mean + slope @ (found - centre - before.mean), np.asarray(cov)


def gain_of(found: Constants, before: Constants, after: Constants) -> float:
    """Gain in log-evidence (nats) if the prior were `after` instead of `before`, Mathematics (exchange-gain)."""
    info, infos = inverse_of(found.cov), [inverse_of(prior.cov) for prior in (before, after)]
    told, by_told = info - infos[0], info @ found.mean - infos[0] @ before.mean
    nats = []
    for prior, own in zip((before, after), infos, strict=True):
        pulled = by_told + own @ prior.mean
        exponent = pulled @ np.linalg.solve(told + own, pulled) - prior.mean @ own @ prior.mean
        nats.append(0.5 * (exponent + np.linalg.slogdet(own)[1] - np.linalg.slogdet(told + own)[1]))
    return float(nats[1] - nats[0])


def moved(space: RigidSpace, pose: np.ndarray, by: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose (E,) moved by (d,) in its right chart, and the covariance (n, n), whose first block is the pose's, there."""
    turn = block_diag(space.right_jacobian(by), np.eye(len(cov) - len(by)))
    return space.retract(pose, by), turn @ cov @ turn.T


class SubMap(NamedTuple):
    """A finished sub-map: its end (E,) relative to its start, landmarks (M,) at `points` (M, D) relative to its end.

    `cov` is that of the end, in its right chart, the points and the `constants` (k,), (d + MD + k, d + MD + k).
    """

    end: np.ndarray
    ids: np.ndarray
    points: np.ndarray
    cov: np.ndarray
    tied: bool = True  #: starts at the end of the previous one; else `end` and its block of `cov` are not used.
    given: Given | None = None  #: the prior it started with; None without one.
    constants: np.ndarray = NOTHING.mean

    @property
    def mean(self) -> np.ndarray:
        """The mean that belongs to `cov`."""
        pose = len(self.cov) - self.points.size - self.constants.size
        return np.concatenate([np.zeros(pose), self.points.ravel(), self.constants])

    @property
    def inherited(self) -> np.ndarray:
        """Names (K,) of the landmarks in its prior."""
        return self.ids[:0] if self.given is None else self.given.ids

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Rows of landmarks (K,)."""
        row_of = {landmark: row for row, landmark in enumerate(self.ids.tolist())}
        return np.array([row_of[landmark] for landmark in ids.tolist()], dtype=np.int64)

    def columns(self, rows: np.ndarray) -> np.ndarray:
        """Columns (d + KD + k,) of `cov`: the end's, those of landmarks by row (K,), and the constants'."""
        size, dim, last = len(self.cov), self.points.shape[1], len(self.cov) - self.constants.size
        d = last - self.points.size
        points = (d + dim * rows[:, None] + np.arange(dim)).ravel()
        return np.concatenate([np.arange(d), points, np.arange(last, size)])

    def of(self, rows: np.ndarray) -> "SubMap":
        """The sub-map with only the landmarks in these rows."""
        columns = self.columns(rows)
        return self._replace(ids=self.ids[rows], points=self.points[rows], cov=principal(self.cov, columns))

    def seeing(self, seen: Given) -> "SubMap":
        """The sub-map with further landmarks observed from its end."""
        last = len(self.cov) - self.constants.size
        order = np.insert(np.arange(len(self.cov)), last, len(self.cov) + np.arange(seen.points.size))
        cov = principal(block_diag(self.cov, seen.cov), order)
        return self._replace(ids=np.append(self.ids, seen.ids), points=np.append(self.points, seen.points, 0), cov=cov)


def inverse_of(cov: np.ndarray) -> np.ndarray:
    """Inverse of a sub-map's covariance. Raises InputError: it is singular or not a covariance."""
    try:
        return gaussian.inverse(cov)
    except InputError as error:
        raise InputError(
            "a sub-map's covariance is singular: the filter has diverged, or a noise is stated as 0"
        ) from error


class Factor(NamedTuple):
    """A sub-map's factor on starts and landmarks in `columns` (c,): residual (r,), information (r, r), Jacobian (r, c).

    `own` (r,) are its columns in the sub-map's Gaussian. The Jacobian is `by_ends` (r, 2d), then Rᵀ for each of the
    landmarks' `rows`, and 1 for constants.
    """

    own: np.ndarray
    columns: np.ndarray
    info: np.ndarray
    residual: np.ndarray
    by_ends: np.ndarray
    rotation: np.ndarray
    rows: slice

    def through(self, left: np.ndarray) -> np.ndarray:
        """A matrix (m, r) times the Jacobian."""
        out = np.concatenate([left @ self.by_ends, left[:, self.rows.start :]], axis=1)
        turned = left[:, self.rows].reshape(len(left), -1, len(self.rotation)) @ self.rotation.T
        first = self.by_ends.shape[1]
        out[:, first : first + turned[0].size] = turned.reshape(len(left), -1)
        return out


class Solution(NamedTuple):
    """Landmarks (M,) in the world (M, D), all starts, the constants, and the factorised joint information (n, n)."""

    ids: np.ndarray
    world: np.ndarray
    starts: np.ndarray
    constants: np.ndarray
    factors: list[Factor]
    eliminated: Elimination
    is_whole: bool  #: whether it is a minimum with the priors subtracted: (almost) no information is counted twice.

    def seen_from(self, space: RigidSpace, number: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks by row (K,) relative to a start (K, D), and the joint covariance of the start, them and the constants."""
        d, dim = space.dim, self.world.shape[1]
        start, first = self.starts[number], d * (len(self.starts) - 1)
        seen = space.inverse_transform(start, self.world[rows])
        points, last = (first + dim * rows[:, None] + np.arange(dim)).ravel(), first + self.world.size
        columns = np.concatenate([d * number - d + np.arange(d), points, last + np.arange(self.constants.size)])
        turn, own = np.eye(columns.size), slice(d, d + points.size)
        turn[own, :d] = -space.transform_jacobian(seen).reshape(-1, d)
        turn[own, own] = np.kron(np.eye(rows.size), space.rotation(start).T)
        return seen, gaussian.symmetrise(turn @ self.eliminated.marginal(columns) @ turn.T)


def solve(
    space: RigidSpace,
    maps: list[SubMap],
    ids: np.ndarray,
    starts: np.ndarray,
    world: np.ndarray,
    constants: np.ndarray,
    off: float = 1.0,
) -> Solution:
    """Gauss-Newton over all starts and some landmarks (M,); other landmarks of a sub-map are marginalised out.

    It starts at `starts` (T + 1, E), of T sub-maps and of the next one, at landmarks in the `world` (M, D), and at
    `constants` (k,). The priors of all sub-maps but the first are subtracted with the factor `off`. They were linearised
    elsewhere: if the difference has no minimum, slightly less is subtracted; if a tenth less does not help, as after
    divergence, nothing.
    """
    d, dim, k, first_guess = space.dim, world.shape[1], constants.size, (starts, world, constants)
    starts, world = starts.copy(), world.copy()
    place = {landmark: row for row, landmark in enumerate(ids.tolist())}
    first = d * len(maps)
    size = first + dim * ids.size + k
    common, parts, loose = np.arange(size - k, size), [], _added_covariances(space, maps, starts)
    for number, each in enumerate(maps):
        rows = np.array([row for row, landmark in enumerate(each.ids.tolist()) if landmark in place], dtype=np.int64)
        own = each.columns(rows)
        at = np.array([place[landmark] for landmark in each.ids[rows].tolist()], dtype=np.int64)
        columns = np.append(d * number + np.arange(-d, d), first + dim * at[:, None] + np.arange(dim))
        columns = np.append(columns, common)
        cov = loosened(principal(each.cov, own), d, loose[number][0][rows])
        if each.tied:
            if np.diagonal(cov)[:d].min(initial=np.inf) < AT_REST**2:
                cov = cov + np.diag(np.where(np.arange(len(cov)) < d, AT_REST**2, 0.0))
            info = inverse_of(cov)
        else:
            info, columns[:d] = np.zeros(cov.shape), np.arange(-d, 0)
            info[d:, d:] = inverse_of(cov[d:, d:])
        parts.append((rows, at, own, columns, info))
    # Subtract each sub-map's prior: it is information of other sub-maps.
    taken = []
    for number, each in enumerate(maps):
        if number and each.given is not None and off:
            at = np.array([place[landmark] for landmark in each.inherited.tolist()], dtype=np.int64)
            columns = np.append(d * number + np.arange(-d, 0), first + dim * at[:, None] + np.arange(dim))
            columns = np.append(columns, common)
            cov = loosened(each.given.cov, 0, loose[number][1])
            taken.append((number, each.given, at, columns, off * inverse_of(cov)))
    blocks = [columns for *_, columns, _ in parts] + [columns for *_, columns, _ in taken]
    free = [columns >= 0 for columns in blocks]  # the first start is the world's origin
    blocks = [columns[own] for columns, own in zip(blocks, free, strict=True)]
    cliques = cliques_of(size, blocks)
    for _ in range(ITERATIONS):
        factors, summands, gradient = list[Factor](), list[np.ndarray](), np.zeros(size + d)
        for number, (rows, at, own, columns, info) in enumerate(parts):
            each = maps[number]
            begin, end = starts[number], starts[number + 1]
            between = space.between(begin, end)
            error, seen = space.local(each.end, between), space.inverse_transform(end, world[at])
            residual = np.concatenate([error, (seen - each.points[rows]).ravel(), constants - each.constants])
            by_ends, back = np.zeros((residual.size, 2 * d)), space.right_jacobian_inverse(error)
            by_ends[:d, :d] = -back @ space.adjoint(space.inverse(between))
            by_ends[:d, d:] = back
            by_ends[d : d + seen.size, d:] = -space.transform_jacobian(seen).reshape(-1, d)
            half, product = _weighed(info, by_ends, space.rotation(end), d, k)
            summands.append(product)
            gradient[columns] += half @ residual  # negative columns index the padding at the end
            factors.append(Factor(own, columns, info, residual, by_ends, space.rotation(end), slice(d, d + seen.size)))
        for number, given, at, columns, info in taken:
            seen = space.inverse_transform(starts[number], world[at])
            by_start = np.pad(-space.transform_jacobian(seen).reshape(-1, d), ((0, k), (0, 0)))
            half, product = _weighed(-info, by_start, space.rotation(starts[number]), 0, k)
            summands.append(product)
            gradient[columns] += half @ np.append(seen - given.points, constants - given.constants)
        summands = [part if own.all() else part[np.ix_(own, own)] for part, own in zip(summands, free, strict=True)]
        try:
            eliminated = Elimination(size, blocks, cliques, summands)
        except LinAlgError as error:
            if taken:
                return solve(space, maps, ids, *first_guess, off=LESS[off])
            raise InputError("the sub-maps leave a start or a landmark undetermined") from error
        step = -eliminated.solve(gradient[:size])
        starts[1:] = space.retract(starts[1:], step[:first].reshape(-1, d))
        world += step[first : size - k].reshape(-1, dim)
        constants = constants + step[size - k :]
        if -step @ gradient[:size] < ENOUGH**2:
            break
    return Solution(ids, world, starts, constants, factors, eliminated, is_whole=off > 0.0)


def _added_covariances(
    space: RigidSpace, maps: list[SubMap], starts: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Covariances to add to each sub-map's landmarks (M, D, D), and to those of its prior (K, D, D).

    They are the landmarks' later random walk, Mathematics (passed-on-walk), and a minimum for the driving substate.
    """
    dim, since, found = maps[0].points.shape[1], dict[int, np.ndarray](), []
    none = np.zeros((dim, dim))
    for each, start, end in zip(reversed(maps), starts[-2::-1], starts[:0:-1], strict=True):
        both = list[np.ndarray]()
        for ids, turn in ((each.ids, space.rotation(end)), (each.inherited, space.rotation(start))):
            if both and each.given is not None and each.given.walked.size:
                walked = turn @ each.given.walked @ turn.T
                since |= {name: since.get(name, none) + by for name, by in zip(ids.tolist(), walked, strict=True)}
            by_all = np.array([since.get(name, none) for name in ids.tolist()]).reshape(-1, dim, dim)
            # Pseudo-landmarks that hold the driving substate at the seam of two sub-maps.
            are_seams = (ids < 0) & (ids > FORGOTTEN)
            both.append(turn.T @ by_all @ turn + EXACT**2 * are_seams[:, None, None] * np.eye(dim))
        found.append((both[0], both[1]))
    return found[::-1]


def loosened(cov: np.ndarray, first: int, by: np.ndarray) -> np.ndarray:
    """Adds (M, D, D) to the covariance of points in columns from `first` on."""
    at = first + np.arange(by.shape[0] * by.shape[1]).reshape(by.shape[:2])
    cov = cov.copy()
    cov[at[:, :, None], at[:, None, :]] += by
    return cov


def _weighed(
    info: np.ndarray, by_poses: np.ndarray, rotation: np.ndarray, first: int, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Jᵀ I and Jᵀ I J for information I (r, r) and a sparse Jacobian J, computed without its zeros.

    J has columns of poses (r, c), then of landmarks, each with Rᵀ in rows of its own from `first` on, then of k constants,
    each with 1 in one of the last rows.
    """
    rows, dim = len(info), len(rotation)
    last = rows - k
    count = (last - first) // dim
    by_points = (rotation @ info[first:last].reshape(count, dim, rows)).reshape(count * dim, rows)
    half = np.concatenate([by_poses.T @ info, by_points, info[last:]])
    turned = half[:, first:last].reshape(len(half), count, dim) @ rotation.T
    turned = turned.reshape(len(half), count * dim)
    return half, np.concatenate([half @ by_poses, turned, half[:, last:]], axis=1)


def fused(space: RigidSpace, new: SubMap, old: SubMap, between: np.ndarray) -> SubMap:
    """Fuses two sub-maps into one relative to the new one's end; the old one's end is at `between` relative to it.

    Landmarks, the new one's end and the old one's are solved for jointly; the old one's start is marginalised out.
    """
    ids = np.append(new.ids, np.setdiff1d(old.ids, new.ids))
    points = np.concatenate([new.points, space.transform(between, old.points[old.rows(ids[new.ids.size :])])])
    starts = np.array([space.identity(), new.end, space.compose(new.end, between)])
    both = [new, old._replace(tied=False)]
    solution = solve(space, both, ids, starts, space.transform(new.end, points), new.constants)
    seen, cov = solution.seen_from(space, 1, np.arange(ids.size))
    return SubMap(solution.starts[1], ids, seen, cov, given=new.given, constants=solution.constants)
