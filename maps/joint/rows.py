"""The rows of a step of a joint map: linearised and stacked, their Kalman update, and the outliers among them.

Outliers are classified jointly, once for all particles, as all observe one Gaussian, Mathematics (joint-outliers).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dtrtri
from scipy.special import digamma, gammaln

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core.linearisation import linearise
from rbpf.core.models import NEW, NULL, FusedKernel, Likelihood, Observations, Part
from rbpf.core.particles import Information, weighted_mean
from rbpf.errors import InputError
from rbpf.kernels.dense import add_gram, add_inner, add_turned, congruent, gather, grams, mirror, principal, product
from rbpf.kernels.landmarks import linearise_group
from rbpf.lie import Array
from rbpf.maps.joint.columns import JointColumns, Kind
from rbpf.maps.rows import GAUSSIAN

QUICK = 30_000_000
"""Multiplications up to which products are independent of the number of threads; beyond, BLAS is ten times as fast."""
DIVERGED = 1e7
"""Ratio of predicted standard deviations beyond which rounding leaves nothing of the smaller one's variance."""
WHOLE = 128
"""Rows below which splitting a covariance into quarters does not pay."""
TINY = float(np.finfo(float).tiny)
WIDE = 3.0
"""Standard deviations of coordinates learnt alone that are added to the noise for everything else."""
LINEARISATIONS = 3
SETTLED = 0.1
"""Maximum linearisations of coordinates learnt alone, and the step, in standard deviations, that ends them."""
ROUNDS, SAME, STRIDE = 10, 0.02, 1.5
"""Variational rounds that learn each measurement's noise: maximum number, relative change that ends them, and factor of
over-relaxation in the logarithm, which saves a third of the rounds and ends closer to the fixed point."""
IN_WORLD = frozenset({Part.STATE})
"""What a model reads that measures the world pose."""


class Group(NamedTuple):
    """Observations of a step with one likelihood: their rows (K, p), and the log-odds (K,) that they are inliers."""

    likelihood: Likelihood
    rows: np.ndarray
    log_odds: np.ndarray
    kind: Kind | None  #: of the landmarks, or None.
    #: (K, p) their change by `WIDE` standard deviations of a coordinate learnt alone, or None.
    along: np.ndarray | None = None


class Rows(NamedTuple):
    """All rows of a step: ν and H in one (R, 1 + d, N), and, common to all particles, J P (R, n), S (R, R).

    J is sparse: a row reads the map in columns `at` (R, q), by slopes (R, q).
    """

    said: np.ndarray
    at: np.ndarray
    slope: np.ndarray
    carried: np.ndarray
    cov: np.ndarray
    groups: list[Group]
    log_factor: float

    @property
    def nu(self) -> np.ndarray:
        return self.said[:, 0].T

    def through(self, matrix: np.ndarray) -> np.ndarray:
        """J times (n, m)."""
        out = np.empty((len(self.at), matrix.shape[1]))
        gather(self.at, self.slope, np.ascontiguousarray(matrix), out)
        return out

    def set_apart(self) -> "Rows":
        """The rows for all other variables: with coordinates learnt alone as additional noise, Mathematics (learnt-alone)."""
        if all(group.along is None for group in self.groups):
            return self
        cov = self.cov.copy()
        for group in self.groups:
            if group.along is not None:
                cov[group.rows[:, :, None], group.rows[:, None]] += group.along[:, :, None] * group.along[:, None]
        return self._replace(cov=cov)

    def inliers(self) -> np.ndarray | slice:
        """The rows of inliers, in descending order of log-odds."""
        if all(group.likelihood.kernel_id == 0 for group in self.groups):
            return slice(None)
        pairs = [pair for group in self.groups for pair in zip(group.log_odds, group.rows, strict=True)]
        found = [(-odds, *rows) for odds, rows in pairs if odds >= 0.0]
        return np.array([row for _, *rows in sorted(found, key=lambda each: each[0]) for row in rows], dtype=np.int64)

    def factor(self) -> tuple[np.ndarray | slice, np.ndarray]:
        """The `inliers`, and the Cholesky factor of their covariance. Raises InputError: it is not positive definite."""
        inside = self.inliers()
        cov = self.cov[inside][:, inside]
        try:
            return inside, gaussian.cholesky(cov) if len(cov) else cov
        except InputError as error:
            std = np.sqrt(np.abs(np.diagonal(cov)))
            if not std.max() > DIVERGED * std.min():
                raise
            words = f"observations are predicted with standard deviations from {std.min():.1e} to {std.max():.1e}"
            raise InputError(f"{words}: the map diverged; observe more landmarks in a step") from error

    def moving(self, gain: np.ndarray, turn: np.ndarray) -> "Rows":
        """Adds to the state Jacobian that the map moves with the state, by gain (n, d) times turn (N, d, d), in place."""
        add_turned(self.said, self.through(gain), turn)
        return self

    def information(self) -> Information:
        """The rows' information about the state."""
        inside, chol = self.factor()
        _, size, n = self.said.shape
        info, vector, quad = np.empty((n, size - 1, size - 1)), np.empty((n, size - 1)), np.empty(n)
        white = whitened(chol, self.said[inside].reshape(len(chol), size * n))
        grams(white.reshape(len(chol), size, n), info, vector, quad)
        log_factor, is_density = self.log_factor, np.ones(len(self.cov), dtype=bool)
        for likelihood, own, log_odds, *_ in self.groups:
            if likelihood.kernel_id != 0:
                count = int((log_odds >= 0.0).sum())
                log_factor += count * likelihood.log_inlier() + (len(own) - count) * likelihood.log_outlier()
                is_density[own] = likelihood.normalised
        nothing = 0.0  # effective number of rows used up by coordinates learnt alone
        for group in self.groups:
            if group.along is not None:
                taken = group.log_odds >= 0.0
                along, spread = group.along[taken], diagonal_blocks(self.cov, group.rows[taken])
                nothing += float((along * np.linalg.solve(spread, along[..., None])[..., 0]).sum())
        of_all = log_det(chol.diagonal()[is_density[inside]]), log_factor, len(chol) - nothing
        return Information(info, vector, quad, *np.full((n, 3), of_all).T)

    def update(self, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One gain for all: log p(z | x) (N,), the means' change (N, n), and the updated covariance, in place."""
        inside, chol = self.factor()
        nu = whitened(chol, self.said[inside, 0]).T
        total = self.log_factor - 0.5 * (np.square(nu).sum(axis=1) + log_det(np.diagonal(chol)))
        total += beyond_gaussian(self, inside, chol, nu)
        half = whitened(chol, self.carried[inside])
        moves = nu @ half if nu.size * half.shape[1] > QUICK else product(np.ascontiguousarray(nu), half)
        return total, moves, plus_gram(cov, half, -1.0)


class Reading:
    """The structure of a step's observations of a joint map, independent of the linearisation point.

    Args:
        held: the map's columns.
        cov: (n, n) of the map.
        groups: the observations.
        compiled: use the models' fused kernels where they have one.
    """

    def __init__(self, held: JointColumns, cov: np.ndarray, groups: Sequence[Observations], compiled: bool) -> None:
        self._table, self._groups, self._of, self.held = held.table, groups, cov, held
        self._cov, self._log_factor = np.ascontiguousarray(cov), 0.0
        # Measurements, their kind of landmark, rows (K, p), and kernel.
        self._parts = list[tuple[np.ndarray, Kind | None, np.ndarray, FusedKernel | None]]()
        read, noises, first = list[np.ndarray](), list[np.ndarray](), 0
        for group in groups:
            ids, kind, reads = checked_ids(group), None, group.model.reads
            self._log_factor += group.log_factor
            seen = np.arange(len(group.z)) if ids is None else np.flatnonzero(ids >= 0)
            at = [np.zeros((seen.size, 0), dtype=np.int64)]
            if ids is not None:
                new, clutter = int((ids == NEW).sum()), int((ids == NULL).sum())
                self._log_factor += group.log_new * new + group.log_clutter * clutter
                kind = held.of_one_kind(ids[seen])
                at += [kind.columns, kind.clones]
            if Part.SUBSTATE in reads:
                at.append(np.tile(np.arange(held.space.dim, held.first), (seen.size, 1)))
            if reads == IN_WORLD:
                at.append(np.tile(np.arange(held.space.dim), (seen.size, 1)))
            p = group.z.shape[1]
            rows = first + np.arange(seen.size * p).reshape(seen.size, p)
            self._parts.append((seen, kind, rows, held.kernel(group.model, kind) if compiled else None))
            read.append(np.repeat(np.concatenate(at, axis=1), p, axis=0))
            noises.append(group.cov[seen])
            first += rows.size
        widest = max((columns.shape[1] for columns in read), default=0)
        self._at, self._noise = np.zeros((first, widest), dtype=np.int64), np.zeros((first, first))
        for (_, _, rows, _), columns, noise in zip(self._parts, read, noises, strict=True):
            self._at[rows.ravel(), : columns.shape[1]] = columns
            self._noise[rows[:, :, None], rows[:, None]] = noise

    def is_of(self, held: JointColumns, cov: np.ndarray, groups: Sequence[Observations]) -> bool:
        """Whether it was built for these observations, ignoring likelihoods, and the map is unchanged."""
        same = held is self.held and held.table is self._table and cov is self._of and len(groups) == len(self._groups)
        return same and all(
            one.model is two.model and one.z is two.z and one.ids is two.ids and one.cov is two.cov
            for one, two in zip(groups, self._groups, strict=True)
        )

    def rows(self, groups: Sequence[Observations], state: np.ndarray, mean: np.ndarray, origin: Array | None) -> Rows:
        """Linearises all groups, at states (N, E) and the particles' own means (N, n).

        Jacobians by the map are averaged over the particles. `origin` is None if nothing may be observed in the world.
        """
        held, space, (n, d) = self.held, self.held.space, (len(state), self.held.space.dim)
        state, mean = numbers(state, "states"), numbers(mean, "the map's means")
        count, parts = len(self._at), list[Group]()
        said, by_held = np.zeros((count, 1 + d, n)), np.zeros(self._at.shape)
        for group, (seen, kind, rows, kernel) in zip(groups, self._parts, strict=True):
            model, z, at = group.model, group.z[seen], state[:, None]
            log_odds = np.full(seen.size, np.inf) if group.log_odds is None else group.log_odds[seen]
            parts.append(Group(group.likelihood or GAUSSIAN, rows, log_odds, kind))
            if kernel is not None and kind is not None:
                columns = kind.columns, kind.clones, kind.origins
                first = int(rows[0, 0]) if rows.size else 0
                linearise_group(kernel.function.address, kernel.params, state, mean, *columns, z, first, said, by_held)
                if model.about is not None and rows.size:
                    # Averaged over the particles: their Jacobians differ only in second order.
                    centre, middle = space.mean(state, np.full(n, 1.0 / n)), mean.mean(axis=0)
                    const = held.poses(kind, middle) if kind.landmark.anchored else None
                    by_substate = model.by_substate(centre, middle[kind.columns], const).reshape(rows.size, -1)
                    own, used = slice(first, first + rows.size), kind.columns.shape[1] + kind.clones.shape[1]
                    said[own, 0] -= by_substate @ (mean[:, d : held.first] - model.about).T
                    by_held[own, used : used + by_substate.shape[1]] = by_substate
                continue
            landmarks = anchors = substate = None
            if kind is not None:
                landmarks = mean[:, kind.columns]
                anchors = held.poses(kind, mean) if kind.landmark.anchored else None
            if Part.SUBSTATE in model.reads:
                substate = mean[:, None, d : held.first]
            if in_world := model.reads == IN_WORLD:
                if origin is None:
                    name = type(model).__name__
                    raise InputError(f"{name} observes the pose in the world, which sub-maps do not support")
                at = space.compose(space.retract(origin, mean[:, :d]), state)[:, None]
            found, jac = linearise(model, space, z, at, landmarks, anchors, substate)
            # Jacobian of each observation by the Gaussian, in the order of its columns.
            used = list[np.ndarray]()
            if kind is not None:
                assert jac.landmark is not None
                used.append(jac.landmark.mean(axis=0))
            if kind is not None and anchors is not None and jac.state is not None:
                # Moving the clone is moving the state the other way: ∂h/∂C = −∂h/∂y Ad(y⁻¹ C), and C = K Exp(δ).
                turn = space.adjoint(space.between(at, anchors)) @ space.right_jacobian(mean[:, kind.clones])
                used.append(-(jac.state @ turn).mean(axis=0))
            if jac.substate is not None:
                used.append(jac.substate.mean(axis=0))
            if in_world and jac.state is not None:
                # world_from_robot = G Exp(ξ) y moves by Ad(y⁻¹) J_r(ξ) dξ.
                turn = space.adjoint(space.inverse(state)) @ space.right_jacobian(mean[:, :d])
                used.append((jac.state @ turn[:, None]).mean(axis=0))
            if not rows.size:
                continue
            own = slice(int(rows[0, 0]), int(rows[-1, -1]) + 1)
            said[own, 0] = np.broadcast_to(found, (n, *rows.shape)).reshape(n, -1).T
            if jac.state is not None:
                slopes = np.broadcast_to(jac.state, (n, *rows.shape, d)).reshape(n, -1, d)
                said[own, 1:] = slopes.transpose(1, 2, 0)
            slope = np.concatenate(used, axis=2)
            by_held[own, : slope.shape[2]] = slope.reshape(rows.size, -1)
        carried, innovation = np.empty((count, len(self._cov))), self._noise.copy()
        gather(self._at, by_held, self._cov, carried)
        add_inner(self._at, by_held, carried, innovation)
        for number, part in enumerate(parts):
            alone = None if part.kind is None else part.kind.landmark.learnt_alone
            if part.kind is not None and alone is not None and part.rows.size:
                column = part.kind.columns[:, alone]
                if (np.bincount(column) > 1).any():
                    raise InputError(
                        "a group observes a landmark of unknown depth twice: put the second one into another group"
                    )
                std = WIDE * np.sqrt(self._cov[column, column])
                parts[number] = part._replace(along=std[:, None] * by_held[part.rows, alone])
        return Rows(said, self._at, by_held, carried, innovation, parts, self._log_factor)

    def learn_alone(
        self, group: Observations, seen: Group, state: np.ndarray, mean: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Updates the coordinates learnt alone with the remaining information of one group, see `Rows.set_apart`.

        The update is iterated; `seen` has the group's rows of the joint update. Returns the log-density common to all
        particles, means (N, n) and covariance (n, n), Mathematics (learnt-alone).
        """
        assert seen.kind is not None and seen.along is not None
        alone = seen.kind.landmark.learnt_alone
        assert alone is not None
        column = seen.kind.columns[:, alone]
        wide = np.linalg.norm(seen.along, axis=1)
        along = seen.along / np.maximum(wide, TINY)[:, None]
        at, std, done = mean, np.sqrt(self._cov[column, column]), 0
        while True:
            rows = self.rows([group], state, at, None)
            own = rows.groups[0].rows
            # Without parallax there is no epipolar line, and no information along it.
            noise = np.maximum(np.einsum("kp,kpq,kq->k", along, diagonal_blocks(self._noise, own), along), TINY)
            # Of the information 1/r along the epipolar line 1/(r + w²) has already been used.
            ratio = np.where(seen.log_odds >= 0.0, np.square(wide) / noise, 0.0)
            information = ratio / (1.0 + ratio) / noise
            slope = np.einsum("kp,kpq->kq", along, rows.slope[own])
            carried = np.einsum("kp,kpn->kn", along, rows.carried[own])
            within = np.einsum("klq,lq->kl", carried[:, rows.at[own[:, 0]]], slope)
            spread = 1.0 + information * np.diagonal(within)
            reached = np.take_along_axis(carried, column[:, None], 1)[:, 0]
            gain = information * reached / spread
            nu = np.einsum("kp,nkp->nk", along, rows.nu[:, own]) + (at - mean)[:, column] * slope[:, alone]
            moved = mean.copy()
            moved[:, column] += gain * nu
            done += 1
            if done == LINEARISATIONS or (np.abs(moved - at)[:, column] <= SETTLED * std).all():
                break
            at = moved
        # Schmidt-Kalman update: only the coordinate's own rows of the gain are not zero.
        after, mine = self._cov.copy(), np.ix_(column, column)
        after[column] -= gain[:, None] * carried
        after[:, column] = after[column].T
        taken = gain[:, None] * carried[:, column]
        block = self._cov[mine] - taken - taken.T + gain[:, None] * within * gain
        block[np.diag_indices(column.size)] = self._cov[column, column] - gain * reached
        after[mine] = block
        spread += information * np.diagonal(spread_of(nu, np.full(len(nu), 1.0 / len(nu))))
        total = 0.5 * (np.log1p(ratio) - np.log(spread) - information * np.square(nu.mean(axis=0)) / spread).sum()
        return float(total), moved, after


def checked_ids(group: Observations) -> np.ndarray | None:
    """Landmarks (K,) of a group, or None. Raises InputError: the association differs between particles."""
    name, ids = type(group.model).__name__, group.ids
    if group.updates != frozenset({Part.STATE, Part.LANDMARK}):
        raise InputError(f"a joint map's observations update state and landmarks, {name}'s do not")
    if Part.LANDMARK not in group.model.reads:
        return None
    if ids is None or ids.shape != (group.z.shape[0],):
        shape = None if ids is None else ids.shape
        raise InputError(
            f"a joint map takes one association for all particles: {name} needs ids ({group.z.shape[0]},), got {shape}"
        )
    return ids


def log_det(diagonal: np.ndarray) -> float:
    """Log |2πS| of S = L Lᵀ, by the diagonal of L."""
    return 2.0 * float(np.log(diagonal).sum()) + len(diagonal) * float(np.log(2.0 * np.pi))


def diagonal_blocks(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The diagonal blocks (K, p, p) of rows and columns (K, p)."""
    return matrix[rows[:, :, None], rows[:, None, :]]


def with_tails(groups: Sequence[Observations], nu: Array, cov: Array, parts: list[Group]) -> list[Observations]:
    """The groups, with the noise R / λ instead of R for Student-t measurements, Mathematics (joint-tails).

    λ is the mean of λ ~ Γ(ν/2, ν/2) given all such measurements (variational Bayes: R. Piché, S. Särkkä and J. Hartikainen
    2012), and `log_factor` turns their log-density into a lower bound of the true one.

    Args:
        groups: of a step.
        nu: (R,) mean of the innovations under all particles.
        cov: (R, R) their covariance.
        parts: their groups of rows.
    """
    heavy = [
        at for at, group in enumerate(groups) if group.likelihood is not None and np.isfinite(group.likelihood.dof)
    ]
    of_heavy = np.concatenate([parts[at].rows.ravel() for at in heavy])
    place = np.zeros(len(nu), dtype=np.int64)
    place[of_heavy] = np.arange(of_heavy.size)
    nu, cov = nu[of_heavy], principal(cov, of_heavy)
    taken = {
        at: np.ones(len(group.z), bool) if group.ids is None else group.ids >= 0 for at, group in enumerate(groups)
    }
    scales = {at: np.ones(len(parts[at].rows)) for at in heavy}
    weights = {at: np.linalg.inv(groups[at].cov[taken[at]]) for at in heavy}
    for _ in range(ROUNDS if of_heavy.size else 0):
        half, settled = _inverse_root(cov), True  # only the diagonal blocks of cov⁻¹ are needed
        solved = half @ (nu @ half)
        for at in heavy:
            # Noise given all measurements: mean R S⁻¹ν and covariance R − R (S⁻¹) R; then its expected scale.
            own, stated, dof = place[parts[at].rows], groups[at].cov[taken[at]], parts[at].likelihood.dof
            now, p = stated / scales[at][:, None, None], own.shape[1]
            mean = (now @ solved[own][..., None])[..., 0]
            second = mean[:, :, None] * mean[:, None] + now - now @ (half[own] @ half[own].swapaxes(1, 2)) @ now
            ratio = (dof + p) / (dof + np.einsum("kab,kba->k", weights[at], second)) / scales[at]
            settled &= bool((np.abs(1.0 - 1.0 / ratio) <= SAME).all())
            scales[at] = scales[at] * ratio**STRIDE
            cov[own[:, :, None], own[:, None]] += stated / scales[at][:, None, None] - now
        if settled:
            break
    found = list(groups)
    for at, scale in scales.items():
        noise = groups[at].cov.copy()
        noise[taken[at]] /= scale[:, None, None]
        bound = groups[at].log_factor + _bound_of(scale, parts[at].likelihood.dof, noise.shape[-1])
        found[at] = replace(groups[at], cov=noise, likelihood=None, log_factor=bound)
    return found


def _inverse_root(cov: np.ndarray) -> np.ndarray:
    """L⁻ᵀ (n, n) of a covariance L Lᵀ, by recursive quarters: BLAS products are faster than LAPACK's solves."""
    if len(cov) < WHOLE:
        return np.asarray(dtrtri(gaussian.cholesky(cov).T, overwrite_c=True)[0])
    out, first = np.zeros(cov.shape), slice(len(cov) // 32 * 16)  # lanes of BLAS stay whole
    last = slice(first.stop, None)
    out[first, first] = before = _inverse_root(cov[first, first])
    across = before.T @ cov[first, last]
    out[last, last] = after = _inverse_root(cov[last, last] - across.T @ across)
    out[first, last] = -before @ (across @ after)
    return out


def _bound_of(scale: np.ndarray, dof: float, p: int) -> float:
    """The bound's terms besides the log-density, for K measurements of p numbers with means λ (K,); at most 0.

    E log λ instead of log E λ, times p/2, and the Kullback-Leibler divergence of λ's posterior from its prior.
    """
    prior, shape = 0.5 * dof, 0.5 * (dof + p)
    rate = shape / scale
    apart = (shape - prior) * digamma(shape) - gammaln(shape) + gammaln(prior)
    apart += prior * np.log(rate / prior) + shape * (prior / rate - 1.0)
    return float((0.5 * p * (digamma(shape) - np.log(shape)) - apart).sum())


def log_odds_of(nu: np.ndarray, cov: np.ndarray, groups: list[Group]) -> list[np.ndarray]:
    """Log-odds (K,) of all observations given the other inliers, at a local optimum of the set of inliers.

    Starts with the inliers by individual tests; then the observation that contradicts its class most is moved, repeatedly.
    """
    alone = [group.likelihood.log_odds(nu[group.rows], diagonal_blocks(cov, group.rows)) for group in groups]
    taken = [odds >= 0.0 for odds in alone]
    inside = np.concatenate([group.rows[took].ravel() for group, took in zip(groups, taken, strict=True)])
    given = _swept(np.concatenate([cov, nu[:, None]], axis=1), inside, False)
    for _ in range(2 * sum(len(each) for each in taken) + 1):
        found = []
        for (likelihood, rows, *_), took in zip(groups, taken, strict=True):
            # An inlier is tested without itself: ν = Π⁻¹ (S⁻¹ν) with covariance Π⁻¹, Π its block of S⁻¹.
            own, spread = given[rows, -1], diagonal_blocks(given, rows)
            spread[took] = -np.linalg.inv(spread[took])
            own[took] = (spread[took] @ own[took][..., None])[..., 0]
            found.append(likelihood.log_odds(own, gaussian.symmetrise(spread)))
        amiss = [np.where(took, -odds, odds) for took, odds in zip(taken, found, strict=True)]
        worst = max(range(len(groups)), key=lambda g: amiss[g].max(initial=-np.inf))
        if not amiss[worst].max(initial=-np.inf) > 0.0:
            break
        which = amiss[worst].argmax()
        given = _swept(given, groups[worst].rows[which], bool(taken[worst][which]))
        taken[worst][which] ^= True
    return [
        np.where(took, np.maximum(odds, 0.0), np.minimum(odds, -TINY)) for took, odds in zip(taken, found, strict=True)
    ]


def _swept(given: np.ndarray, rows: np.ndarray, back: bool) -> np.ndarray:
    """[S | ν] (R, R + 1) swept by some rows k, or `back`: conditional moments given all swept rows U.

    It holds −S_UU⁻¹ in U, S_UU⁻¹ν beside it, and elsewhere covariance and innovation given U (J. Goodnight 1979).
    """
    inverse, sign = np.linalg.inv(given[np.ix_(rows, rows)]), -1.0 if back else 1.0
    gain, beside = given[:, rows] @ inverse, given[rows]
    given = given - gain @ beside
    given[rows], given[:, rows] = sign * (inverse @ beside), sign * gain
    given[np.ix_(rows, rows)] = -inverse
    return given


def beyond_gaussian(rows: Rows, inside: np.ndarray | slice, chol: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Terms (N,) of non-Gaussian likelihoods in addition to log N of the inliers, Mathematics (joint-outlier-weight).

    Each inlier's own log-density instead of the Gaussian, given the previous inliers; each outlier's, given all inliers.
    """
    total, place = np.zeros(len(white)), np.empty(rows.nu.shape[1], dtype=np.int64)
    place[inside] = np.arange(len(chol))
    for likelihood, own, log_odds, *_ in rows.groups:
        if likelihood.kernel_id == 0:
            continue
        at = place[own[log_odds >= 0.0]]
        lower = diagonal_blocks(chol, at)
        nu, cov = (lower @ white[:, at][..., None])[..., 0], gaussian.gram(lower)
        total += (likelihood.log_density(nu, cov) - gaussian.log_density(nu, cov)).sum(axis=1)
        out = own[log_odds < 0.0]
        half = whitened(chol, rows.cov[inside][:, out.ravel()])
        nu = (rows.nu[:, out.ravel()] - white @ half).reshape(len(white), *out.shape)
        explained = diagonal_blocks(half.T @ half, np.arange(out.size).reshape(out.shape))
        total += likelihood.log_density(nu, diagonal_blocks(rows.cov, out) - explained).sum(axis=1)
    return total


def whitened(chol: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """L⁻¹ (R, R) of rows (R, k), C-contiguous."""
    if not rows.size:
        return rows
    # Transposed, to match the column-major layout of BLAS.
    return np.asarray(dtrsm(1.0, chol.T, np.ascontiguousarray(rows).T, side=1, lower=0).T)


def plus_gram(cov: np.ndarray, rows: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """Cov (n, n) ± rowsᵀ rows, of rows (k, n), in place; exactly symmetric; only the lower triangle of cov is read."""
    if rows.size * len(cov) > QUICK:
        cov = dsyrk(sign, rows.T, beta=1.0, c=cov.T, overwrite_c=True).T  # of the transposed, the upper triangle
    else:
        add_gram(cov, np.ascontiguousarray(rows), sign)
    mirror(cov)
    return cov


def turned(cov: np.ndarray, blocks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The lower triangle of T P Tᵀ; T is the identity but for blocks (K, m, m) on its diagonal, in rows (K, m) one by one."""
    first = np.concatenate([rows[:, 0] for rows, _ in blocks])
    size = np.concatenate([np.full(len(rows), rows.shape[1]) for rows, _ in blocks])
    padded, done = np.zeros((first.size, int(size.max()), int(size.max()))), 0
    for rows, each in blocks:
        padded[done : (done := done + len(rows)), : rows.shape[1], : rows.shape[1]] = each
    return np.asarray(congruent(cov, first, size, padded))


def spread_of(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Unbiased covariance (k, k) of weighted samples (N, k): Σ W δδᵀ / (1 − ΣW²); of one particle, zero."""
    return plus_gram(np.zeros((values.shape[1],) * 2), apart(values, weights))


def apart(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """A factor (N, k) of `spread_of`, which is factorᵀ factor."""
    left = 1.0 - float(np.square(weights).sum())
    return np.sqrt(weights / left if left > 0.0 else 0.0 * weights)[:, None] * (values - weighted_mean(values, weights))
