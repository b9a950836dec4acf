"""What finished sub-maps say together: all their starts and landmarks by Gauss-Newton, Mathematics (submaps)."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, block_diag

from rbpf import gaussian
from rbpf.core.models import RigidSpace
from rbpf.errors import InputError
from rbpf.kernels.dense import principal
from rbpf.maps.joint.elimination import Elimination, cliques_of

ENOUGH, ITERATIONS = 0.1, 20
"""Length of the last step to a solution, in standard deviations of all of it together, and how many there are at most."""
LESS = {1.0: 0.99, 0.99: 0.9, 0.9: 0.0}
"""Of what sub-maps were given, the fraction that is taken off where that before is more than they say."""
FORGOTTEN = -(2**40)
"""Below it are names of what is no landmark any more."""
EXACT, AT_REST = 1e-5, 1e-7
"""Standard deviations [m, rad] of what drives the motion where it is known exactly, and of an end as that of a robot at rest.

Landmarks are known to some micrometres from each other: what is taken for exact must not matter beside that.
"""


class Given(NamedTuple):
    """What was known before a sub-map of landmarks (K,), at `points` (K, D) as seen from its start, and of `constants` (k,).

    `cov` is that of both, (KD + k, KD + k); landmarks have `walked` since, by a covariance (K, D, D).
    """

    ids: np.ndarray
    points: np.ndarray
    cov: np.ndarray
    constants: np.ndarray = np.zeros(0)
    walked: np.ndarray = np.zeros((0, 0, 0))


class Constants(NamedTuple):
    """What is the same in all sub-maps, Mathematics (submap-constants): mean (k,) and covariance (k, k)."""

    mean: np.ndarray
    cov: np.ndarray


NOTHING = Constants(np.zeros(0), np.zeros((0, 0)))


def exchanged(
    mean: np.ndarray, cov: np.ndarray, own: slice, before: Constants, after: Constants
) -> tuple[np.ndarray, np.ndarray]:
    """A Gaussian (…, n), (n, n) had the constants that are `own` of it this prior `after`, Mathematics (exchange).

    What the draws of paths seem to have told without there being anything to tell it by is no information.
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
    """By how many nats what led from a prior `before` to what is `found` is likelier `after`, Mathematics (exchange-gain)."""
    info, infos = inverse_of(found.cov), [inverse_of(prior.cov) for prior in (before, after)]
    told, by_told = info - infos[0], info @ found.mean - infos[0] @ before.mean
    nats = []
    for prior, own in zip((before, after), infos, strict=True):
        pulled = by_told + own @ prior.mean
        exponent = pulled @ np.linalg.solve(told + own, pulled) - prior.mean @ own @ prior.mean
        nats.append(0.5 * (exponent + np.linalg.slogdet(own)[1] - np.linalg.slogdet(told + own)[1]))
    return float(nats[1] - nats[0])


def moved(space: RigidSpace, pose: np.ndarray, by: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose (E,) moved by (d,) in its right chart, and the covariance (n, n) that begins with its own, there."""
    turn = block_diag(space.right_jacobian(by), np.eye(len(cov) - len(by)))
    return space.retract(pose, by), turn @ cov @ turn.T


class SubMap(NamedTuple):
    """A finished sub-map: where it ends as seen from its start (E,), landmarks (M,) at `points` (M, D) as seen from its end.

    `cov` is that of the end, in its right chart, the points and the `constants` (k,), (d + MD + k, d + MD + k).
    """

    end: np.ndarray
    ids: np.ndarray
    points: np.ndarray
    cov: np.ndarray
    tied: bool = True  #: begins where the one before ends; else `end` and its part of `cov` say nothing.
    given: Given | None = None  #: what of all this is not its own; None where it began with nothing.
    constants: np.ndarray = NOTHING.mean

    @property
    def mean(self) -> np.ndarray:
        """Of what `cov` is about."""
        pose = len(self.cov) - self.points.size - self.constants.size
        return np.concatenate([np.zeros(pose), self.points.ravel(), self.constants])

    @property
    def inherited(self) -> np.ndarray:
        """Names (K,) of the landmarks that it began with."""
        return self.ids[:0] if self.given is None else self.given.ids

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Of its landmarks (K,)."""
        row_of = {landmark: row for row, landmark in enumerate(self.ids.tolist())}
        return np.array([row_of[landmark] for landmark in ids.tolist()], dtype=np.int64)

    def columns(self, rows: np.ndarray) -> np.ndarray:
        """Of `cov` those (d + KD + k,) of the end, of landmarks by row (K,), and of the constants."""
        size, dim, last = len(self.cov), self.points.shape[1], len(self.cov) - self.constants.size
        d = last - self.points.size
        points = (d + dim * rows[:, None] + np.arange(dim)).ravel()
        return np.concatenate([np.arange(d), points, np.arange(last, size)])

    def of(self, rows: np.ndarray) -> "SubMap":
        """Without its other landmarks."""
        columns = self.columns(rows)
        return self._replace(ids=self.ids[rows], points=self.points[rows], cov=principal(self.cov, columns))

    def seeing(self, seen: Given) -> "SubMap":
        """With landmarks that are seen from its end besides."""
        last = len(self.cov) - self.constants.size
        order = np.insert(np.arange(len(self.cov)), last, len(self.cov) + np.arange(seen.points.size))
        cov = principal(block_diag(self.cov, seen.cov), order)
        return self._replace(ids=np.append(self.ids, seen.ids), points=np.append(self.points, seen.points, 0), cov=cov)


def inverse_of(cov: np.ndarray) -> np.ndarray:
    """Of a sub-map's covariance. Raises InputError: it is singular, or none."""
    try:
        return gaussian.inverse(cov)
    except InputError as error:
        raise InputError(
            "a sub-map's covariance is singular: the filter has diverged, or a noise is stated as 0"
        ) from error


class Factor(NamedTuple):
    """What a sub-map says of starts and landmarks in `columns` (c,): a residual (r,), its information and slope (r, c).

    `own` (r,) are the columns of the sub-map's Gaussian that it is of. The slope is `by_ends` (r, 2d), then Rᵀ for each of the
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
        """(m, r) times the slope."""
        out = np.concatenate([left @ self.by_ends, left[:, self.rows.start :]], axis=1)
        turned = left[:, self.rows].reshape(len(left), -1, len(self.rotation)) @ self.rotation.T
        first = self.by_ends.shape[1]
        out[:, first : first + turned[0].size] = turned.reshape(len(left), -1)
        return out


class Solution(NamedTuple):
    """Landmarks (M,) in the world (M, D), all starts, the constants, and the information (n, n) of all, eliminated."""

    ids: np.ndarray
    world: np.ndarray
    starts: np.ndarray
    constants: np.ndarray
    factors: list[Factor]
    eliminated: Elimination
    is_whole: bool  #: is a minimum of all that is known, and next to nothing counts twice.

    def seen_from(self, space: RigidSpace, number: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks by rows (K,) as seen from a start by number (K, D), and the covariance of it, them and the constants."""
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
    """Gauss-Newton over all starts and some landmarks (M,); the others of a sub-map are left out of its factor.

    It begins at `starts` (T + 1, E), of T sub-maps and of the next one, at landmarks in the `world` (M, D), and at
    `constants` (k,). What sub-maps but the first were given is taken `off`. It was linearised elsewhere: where that leaves
    no minimum, a little of it stays; where a tenth does not help, as when a filter has diverged, all of it.
    """
    d, dim, k, first_guess = space.dim, world.shape[1], constants.size, (starts, world, constants)
    starts, world = starts.copy(), world.copy()
    place = {landmark: row for row, landmark in enumerate(ids.tolist())}
    first = d * len(maps)
    size = first + dim * ids.size + k
    common, parts, loose = np.arange(size - k, size), [], _looser(space, maps, starts)
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
    # What a sub-map was given is not its own: others say it.
    taken = []
    for number, each in enumerate(maps):
        if number and each.given is not None and off:
            at = np.array([place[landmark] for landmark in each.inherited.tolist()], dtype=np.int64)
            columns = np.append(d * number + np.arange(-d, 0), first + dim * at[:, None] + np.arange(dim))
            columns = np.append(columns, common)
            cov = loosened(each.given.cov, 0, loose[number][1])
            taken.append((number, each.given, at, columns, off * inverse_of(cov)))
    blocks = [columns for *_, columns, _ in parts] + [columns for *_, columns, _ in taken]
    free = [columns >= 0 for columns in blocks]  # the first start is where the world is
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
            gradient[columns] += half @ residual  # columns below zero fall behind the end
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


def _looser(space: RigidSpace, maps: list[SubMap], starts: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """By how much less is known of each sub-map's landmarks (M, D, D), and of those it was given (K, D, D), than it was.

    They have walked since, Mathematics (passed-on-walk); and what drives the motion is never taken for exact.
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
            # No landmarks, but what drove the motion where one sub-map ended and another began.
            are_seams = (ids < 0) & (ids > FORGOTTEN)
            both.append(turn.T @ by_all @ turn + EXACT**2 * are_seams[:, None, None] * np.eye(dim))
        found.append((both[0], both[1]))
    return found[::-1]


def loosened(cov: np.ndarray, first: int, by: np.ndarray) -> np.ndarray:
    """A covariance of which points, in columns from the `first` on, are known less, by (M, D, D)."""
    at = first + np.arange(by.shape[0] * by.shape[1]).reshape(by.shape[:2])
    cov = cov.copy()
    cov[at[:, :, None], at[:, None, :]] += by
    return cov


def _weighed(
    info: np.ndarray, by_poses: np.ndarray, rotation: np.ndarray, first: int, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Jᵀ I and Jᵀ I J of a residual of slope J whose information is I (r, r), at the work of their entries.

    J has columns of poses (r, c), then those of landmarks, each with Rᵀ in rows of its own from the `first` on, then those
    of k constants, each with 1 in one of the last rows.
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
    """What two say of their landmarks, as seen from the end of the new one; the old one ends `between` from there.

    They are solved for with the new one's end and how the old one lies. Where the old one began is left out.
    """
    ids = np.append(new.ids, np.setdiff1d(old.ids, new.ids))
    points = np.concatenate([new.points, space.transform(between, old.points[old.rows(ids[new.ids.size :])])])
    starts = np.array([space.identity(), new.end, space.compose(new.end, between)])
    both = [new, old._replace(tied=False)]
    solution = solve(space, both, ids, starts, space.transform(new.end, points), new.constants)
    seen, cov = solution.seen_from(space, 1, np.arange(ids.size))
    return SubMap(solution.starts[1], ids, seen, cov, given=new.given, constants=solution.constants)
