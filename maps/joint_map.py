"""A map with one joint Gaussian of all landmarks and their frame, given a short sampled window of the path.

A filter that samples its whole path loses information: after resampling all particles share one past, and the deformation of
the old map, which nothing near the robot measures, is sampled only once (T. Bailey, J. Nieto and E. Nebot 2006). Here only
the last few steps are sampled: the state y of a particle is the pose in a frame F, and

    (ξ, s, l_1 … l_M) | y_1:t  ~  N(μ_i, P),        world_from_F = G Exp(ξ),

with the substate s (a velocity, if any) and the landmarks in F. Each particle has its own means; the covariance is common, as
it depends on the path only in second order. `consolidate` ends a window: F moves to the robot, and the particles' spread
becomes part of P, Mathematics (consolidation). Related work: C. Brooks and T. Bailey 2008 (HybridSLAM), E. Eade and T.
Drummond 2007 (coalesced observations).

Anchored landmarks, such as a ray of unknown depth, stay in the frame of the pose that first observed them. That pose is part
of the Gaussian: a *clone*, C = K Exp(δ) in F, which moves with F as landmarks do (A. Mourikis and S. Roumeliotis 2007).
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core import checkpoint
from rbpf.core.genealogy import Lineage
from rbpf.core.models import (
    Belief,
    Landmark,
    LogDensities,
    NewLandmarks,
    ObservationModel,
    Observations,
    Part,
    Records,
    RigidSpace,
    Transition,
)
from rbpf.core.particles import Estimate, Information, Particles, Prior, take, uniform_log_weights, weighted_mean
from rbpf.errors import InputError
from rbpf.kernels.dense import principal
from rbpf.kernels.landmarks import expect_group
from rbpf.lie import Array, LieGroup, SE2Group, SE3Group
from rbpf.maps.joint.columns import JointColumns
from rbpf.maps.joint.present import Present
from rbpf.maps.joint.rows import (
    Group,
    Reading,
    Rows,
    apart,
    diagonal_blocks,
    log_odds_of,
    plus_gram,
    spread_of,
    turned,
    with_tails,
)
from rbpf.maps.joint.solution import Constants, Given, SubMap, exchanged, gain_of, moved
from rbpf.maps.joint.submaps import SubMaps
from rbpf.maps.point import Point
from rbpf.maps.rows import MapOfRecords

LARGEST = 6000
"""Maximum number of landmark coordinates; their covariance takes 0.3 GB, and a step copies it."""
FEWEST = 3
"""Least number of distant landmarks for which all sub-maps are solved."""
LOCAL, WORTH = 3.0, 20
"""Largest extent of a sub-map relative to the range of observation, and least number of landmarks to end it by extent.

The second-order effect of a heading error on a landmark, which a Gaussian neglects, grows with its distance.
"""
SINGULAR = 1e-15
"""Variances of an increment below this fraction of the largest count as zero."""


@final
class JointMap(MapOfRecords):
    """Landmarks, the frame's pose and a substate as one Gaussian; give the filter a `Consolidation` with it.

    It supports points, landmarks anchored at a pose, and any `Landmark` that overrides `seen_from`. The motion and landmark
    observations must be invariant to moving the whole world, as with odometry and sensors on the robot. An observation of the
    state alone, such as a position fix, is of its pose in the world. Associations are common to all particles, all
    observations update state and landmarks, and outliers are classified once for all particles: they update nothing, and
    weigh each particle by its own innovation.

    Args:
        space: SE2 or SE3 with `Point(2)` or `Point(3)`; Euclidean(n), whose points are vectors (n,).
        substate: mean (m,) and covariance (m, m) of the substate that drives the motion (`Transition.coupling`), in the
            robot's frame; or None. It may be observed together with a landmark.
        constants: the last k numbers of the substate are constants, such as systematic errors of a sensor or the wheels,
            common to all sub-maps.
        compiled: use the fused kernels of models that have one.
        submap: maximum landmarks of a sub-map (see also `LOCAL`), which bounds the cost of a step however large the
            map becomes; None is one Gaussian. With it nothing may be observed in the world.
        passed_on: a sub-map ends when landmarks are `put_away`, and the others are passed on to the next one, together with a
            substate that changes; else the next one starts with the constants only.
        unnamed: for unknown association: old sub-maps' landmarks are kept available, see `widened`; not with constants.

    Attributes:
        old: the finished sub-maps. All else is of the current one, whose world is its start.
        held: its landmarks and clones, and their columns.
        mean: (N, n) of ξ, s, and the landmarks and clones in order of their addition.
        cov: (n, n), common to all particles.
        origin: (E,) G.
    """

    evidence = False
    space: RigidSpace

    def __init__(
        self,
        space: RigidSpace,
        substate: tuple[np.ndarray, np.ndarray] | None = None,
        compiled: bool = True,
        submap: int | None = None,
        passed_on: bool = False,
        unnamed: bool = False,
        constants: int = 0,
    ) -> None:
        self.space, self.compiled = space, compiled
        self.point = Point(2 if isinstance(space, SE2Group) else 3 if isinstance(space, SE3Group) else space.dim)
        mean, cov = (np.zeros(0), np.zeros((0, 0))) if substate is None else map(np.asarray, substate)
        if cov.shape != (mean.size, mean.size):
            raise InputError(f"a substate with mean {mean.shape} needs a square cov, got {cov.shape}")
        if not 0 <= constants <= mean.size:
            raise InputError(f"of a substate of {mean.size} numbers {constants} cannot be constants")
        if unnamed and constants:
            raise InputError("unnamed landmarks of old sub-maps are kept without constants: leave them out")
        gaussian.psd_factor(cov)
        self._substate, self._first = (mean, cov), space.dim + mean.size
        self.held = JointColumns(space, self._first, [self.point])
        self.submap, self.unnamed = submap, unnamed
        self.passed_on = passed_on or mean.size > constants
        self._own = slice(self._first - constants, self._first)  # columns of the constants
        self.also = frozenset({Part.STATE, Part.SUBSTATE} if mean.size else {Part.STATE})

    def begin(self, n: int, lineage: Lineage) -> None:
        self.n, self._next_id = n, 0
        self._begin_old(*self._substate)
        self._given_ids = self.leaving = self._returning = np.zeros(0, dtype=np.int64)
        self._observed = self.leaving  # landmarks already observed in this step, which stay until it ends
        self._begin_submap()

    def begin_at(self, origin: np.ndarray, substate: np.ndarray, ids: np.ndarray, cov: np.ndarray) -> None:
        """Initialises a map filled by `add_records`: its frame at `origin` (E,), the substate at (m,).

        `cov` (d + m + ΣD, …) is the joint covariance of the frame (right chart), the substate and landmarks (K,).
        """
        own = slice(self.space.dim, self._first)
        self._begin_old(substate, cov[own, own])
        self.origin, self.mean[:, self.space.dim : self._first] = origin, substate
        table = self.held.table
        each = [(table.first[row], self.held.kinds[table.kind[row]].dim) for row in self.held.rows_of(ids)]
        columns = np.concatenate([np.arange(self._first), *(first + np.arange(dim) for first, dim in each)])
        self.cov[np.ix_(columns, columns)] = gaussian.symmetrise(cov)

    def _begin_old(self, mean: np.ndarray, cov: np.ndarray) -> None:
        """No finished sub-map, and the substate's prior; its constants are shared with all sub-maps."""
        own = slice(self._own.start - self.space.dim, None)
        self.old = SubMaps(
            self.space, self.point.dim, 2 * (self.submap or 0), self.unnamed, Constants(mean[own], cov[own, own])
        )

    def _begin_submap(self) -> None:
        """Starts a sub-map at the robot, without landmarks, with all sub-maps' estimate of the constants."""
        d, n = self.space.dim, self.n
        self.origin = self.space.identity()
        self.mean = np.zeros((n, self._first))
        self.cov = np.zeros((self._first, self._first))
        self.mean[:, d:], self.cov[d:, d:] = self._substate if self.passed_on else self.old.known
        self.held = JointColumns(self.space, self._first, self.held.kinds)
        self._walked = dict[int, np.ndarray]()  # random walk of its landmarks, relative to its start
        self._reach = 0.0  # largest distance from the frame of its landmarks at their initialisation
        self._leave_step()

    def _leave_step(self) -> None:
        self._in_step = False  # from prediction to correction: associations refer to the current landmarks
        self._gain: np.ndarray | None = None
        self._rest: np.ndarray | None = None
        self._reading: Reading | None = None  # of this step's observations

    def presume(self, prior: Constants) -> None:
        """At the end of a window: replaces the constants' initial prior by this one in all estimates."""
        before, d = self.old.prior, self.space.dim
        self.old.presume(prior)
        mean, cov = exchanged(self.mean, self.cov, self._own, before, prior)
        self.origin, turn = moved(self.space, self.origin, mean[0, :d], cov)
        mean[:, :d] = 0.0
        self.mean, self.cov = mean, turn
        if self.old.maps:
            if not self.passed_on:  # else `about` is the prior of this one
                self.old.solve()
            self.old.look_from(self.finished())

    def pose_by_constants(self, particles: Particles) -> np.ndarray:
        """Regression (d, k) of the robot's world pose on the constants, in the chart at its mean."""
        present, d = self._consolidated(particles), self.space.dim
        if self.old.maps:
            cov = self.old.end_and_constants(present.finished(self.old))[1]
        else:
            cov = principal(present.cov, np.append(np.arange(d), present.constants(self.old)))
        return np.linalg.solve(cov[d:, d:], cov[d:, :d]).T

    def presumed(self, particles: Particles, prior: Constants) -> tuple[Constants, float]:
        """The constants' estimate if they had this prior, and the gain in log-evidence (nats)."""
        own = self.mean[:, self._own]
        mean, cov = gaussian.mixture_moments(particles.weights, own, self.cov[self._own, self._own][None])
        found = exchanged(mean, cov, slice(0, mean.size), self.old.prior, prior)
        return Constants(*found), gain_of(Constants(mean, cov), self.old.prior, prior)

    def driving(self) -> np.ndarray | None:
        return self.mean[:, self.space.dim : self._first] if self._first > self.space.dim else None

    def predict(self, transition: Transition, space: LieGroup, dt: float) -> Prior | None:
        """Joint distribution of the increment ε and the map, stored as (ξ, s, l) | ε; unchanged without a substate."""
        coupling, dynamics, drift = transition.coupling, transition.dynamics, transition.drift
        d, m = space.dim, self._first - space.dim
        self._in_step = True
        if not m:
            return None
        sizes = [None if block is None else block.shape[1:] for block in (coupling, dynamics, drift)]
        if coupling is None or dynamics is None or drift is None or sizes != [(d, m), (m, m), (m,)]:
            raise InputError(
                f"the substate has {m} numbers: the motion model must give coupling (·, {d}, {m}), dynamics "
                f"(·, {m}, {m}) and drift (·, {m}), not {sizes}"
            )
        here = slice(d, self._first)
        substate = self.mean[:, here, None]
        self._increment_mean = (coupling @ substate)[..., 0]
        # Differences between particles change the covariance only in second order.
        blocks = coupling, dynamics, transition.noise_factor
        B, A, L = (block[0] if len(block) == 1 else block.mean(axis=0) for block in blocks)
        noise, cov = L @ L.T, self.cov
        increment = gaussian.symmetrise(B @ cov[here, here] @ B.T) + noise[:d, :d]
        cross = cov[:, here] @ B.T
        self._predicted = self.mean
        if L[d:].any() or drift.any() or not (dynamics == np.eye(m)).all():  # else the map is unchanged
            self._predicted = self.mean.copy()
            self._predicted[:, here] = (dynamics @ substate)[..., 0] + drift
            cov = cov.copy()
            cov[here] = A @ cov[here]
            cov[:, here] = cov[:, here] @ A.T
            cov[here, here] += noise[d:, d:]
            cross[here] = A @ cross[here] + noise[d:, :d]
        values, vectors = np.linalg.eigh(increment)
        if values[0] < 0.0:  # rounding errors, if an exact motion determines the substate
            values = np.maximum(values, 0.0)
            increment = gaussian.symmetrise((vectors * values) @ vectors.T)
        known = values > SINGULAR * values[-1]
        root = vectors[:, known] / np.sqrt(values[known])
        half = cross @ root
        self._gain, self._rest, self._before = half @ root.T, None, (cov, half)
        factor = gaussian.psd_factor(increment)[None]
        return Prior(space, transition.mean, self._increment_mean, factor, centred=False)

    def decided(self, groups: Sequence[Observations], belief: Belief) -> Sequence[Observations]:
        """Learns heavy-tailed observations' noise, Mathematics (joint-tails), and classifies outliers (joint-outliers)."""
        if any(group.likelihood is not None and np.isfinite(group.likelihood.dof) for group in groups):
            groups = with_tails(groups, *self._foreseen(groups, belief))
        if all(group.likelihood is None or group.likelihood.kernel_id == 0 for group in groups):
            return groups
        chosen = iter(log_odds_of(*self._foreseen(groups, belief)))
        decided = []
        for group in groups:
            log_odds = np.full(len(group.z), np.inf)
            log_odds[slice(None) if group.ids is None else group.ids >= 0] = next(chosen)
            decided.append(replace(group, log_odds=log_odds))
        return decided

    def information(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Information:
        ids = [group.ids.ravel() for group in groups if group.ids is not None]
        self._observed = np.concatenate([np.zeros(0, dtype=np.int64), *ids])
        return self._seen_through(state, groups, prior).set_apart().information()

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        """Log p(z | x), and one Kalman update by all rows: one gain, one covariance, each particle's innovations."""
        self.mean, self.cov = self._given(increment)
        self._gain, self._in_step, self._observed = None, False, self._observed[:0]
        if not groups:
            return LogDensities(np.zeros(self.n), np.zeros(self.n))
        rows = self._rows(state, self.mean, self.cov, groups)
        total, moves, self.cov = rows.set_apart().update(self.cov)
        self.mean, self._reading = self.mean + moves, None
        for group, seen in zip(groups, rows.groups, strict=True):
            if seen.along is not None:
                reading = Reading(self.held, self.cov, [group], self.compiled)
                told, self.mean, self.cov = reading.learn_alone(group, seen, state, self.mean)
                total += told
        return LogDensities(total, np.zeros_like(total))

    def resample(self, ancestors: np.ndarray) -> None:
        self.n, self.mean = ancestors.size, self.mean[ancestors]
        if self._gain is not None:
            self._predicted = self._predicted[ancestors]
            self._increment_mean = take(self._increment_mean, ancestors)

    def consolidate(self, particles: Particles) -> Particles:
        """Ends the window: the frame moves to the robot; the particles' spread enters the common covariance."""
        self._take(self._consolidated(particles))
        if self.submap is not None:
            if self.leaving.size or self._returning.size:
                self._exchange()
            # Without `passed_on` a sub-map that is joined to the old ones is followed by an empty one.
            elif not (self._in_step or self.passed_on) and self.old.take(self.finished(), self._is_large()):
                self._begin_submap()
            if self.old.maps:
                self.old.look_from(self.finished())
        return Particles(self.space.identity((self.n,)), uniform_log_weights(self.n))

    def _is_large(self) -> bool:
        """Whether the current sub-map should end: it is too costly per step, or too extended for one Gaussian."""
        assert self.submap is not None
        away = np.linalg.norm(self.mean[0, self.held.of_one_kind(self.ids).columns], axis=1)
        return away.size >= self.submap or (away.size >= WORTH and bool(away.max() > LOCAL * self._reach))

    @property
    def is_full(self) -> bool:
        """Whether the sub-map has more landmarks than it should, without those that leave."""
        return self.submap is not None and np.setdiff1d(self.ids, self.leaving).size > self.submap

    def make_room(self, order: np.ndarray) -> np.ndarray:
        """Removes the first of these landmarks (K,) until a sub-map is half full, if they are enough for a sub-map.

        Points are put away, anchored ones dropped. Returns those (k,) removed now or at the end of the window.
        """
        assert self.submap is not None
        held = np.setdiff1d(self.ids, self.leaving).size
        away = order[: max(held - self.submap // 2, 0) if order.size >= self.submap // 4 else 0]
        points = self.are(away, self.point)
        self.put_away(away[points])
        self.remove(away[~points])
        return away

    def put_away(self, ids: np.ndarray) -> None:
        """Moves points (K,) to old sub-maps at the end of the window: the current one ends there, the rest is passed on."""
        self.leaving = np.union1d(self.leaving, ids)

    def bring_back(self, ids: np.ndarray) -> bool:
        """Adds points (K,) of old sub-maps at the end of the window, with all information about them; others stay.

        Returns whether any can be added: those not around the current start need at least three, the number that determines a
        pose in space; fewer do not justify a joint solution.
        """
        if not ids.size and not self._returning.size:
            return False
        self._returning = np.union1d(self._returning, ids[~self.holds(ids)])
        self.leaving = np.setdiff1d(self.leaving, ids)
        near = np.isin(self._returning, self.old.about.ids)
        return bool(near.any()) or np.isin(self._returning[~near], self.old.ids).sum() >= FEWEST

    def _exchange(self) -> None:
        """Moves points to and from old sub-maps, Mathematics (passed-on); all particles are equal."""
        leaving = self.leaving[self.holds(self.leaving)]
        returning = np.intersect1d(self._returning[~self.holds(self._returning)], self.old.ids)
        observed = np.isin(leaving, self._observed)
        self._returning, self.leaving, leaving = leaving[:0], leaving[observed], leaving[~observed]
        far = int((~np.isin(returning, self.old.about.ids)).sum()) >= FEWEST
        present = self._present()
        if leaving.size or far:
            present.pass_on(self.old, leaving, returning if far else None)
        present.bring_in(self.old, returning[np.isin(returning, self.old.about.ids)])
        self._take(present)

    def finished(self) -> SubMap:
        """The current sub-map if it ended here, at the end of a window."""
        return self._present().finished(self.old)

    def _present(self) -> Present:
        """The current sub-map at the end of a window, when all particles are equal."""
        return Present(self.origin, self.held, self.mean[0], self.cov, self._given_ids, self._walked)

    def _take(self, present: Present) -> None:
        """Sets all particles to the current sub-map."""
        self.origin, self.held, self.cov, self._given_ids = present.origin, present.held, present.cov, present.given
        self._walked = present.walked
        self.mean = np.repeat(present.mean[None], self.n, axis=0)

    def recognise(self, seen: Given, tied: bool = True) -> None:
        """Loop closure: points of old sub-maps are re-observed from the frame, at the end of a window.

        The current sub-map, which does not have them, ends here with them, all are solved jointly with new linearisation
        points, and the points are added. If not `tied`, without known motion to here, the sighting becomes a sub-map of its
        own and only the substate is kept.
        """
        present = self._present()
        if tied:
            present.pass_on(self.old, seen.ids[:0], seen.ids, seen)
            present.bring_in(self.old, seen.ids)
        else:
            present.begin_again(self.old, seen)
            self.leaving = self._returning = seen.ids[:0]
            self._leave_step()
        self._take(present)
        self.old.look_from(self.finished())

    def widened(self) -> "JointMap":
        """A read-only copy extended by nearby landmarks of old sub-maps, for predicting their observations."""
        wide = copy(self)
        if self.old.beside is not None:
            wide.held, wide.mean, wide.cov = self.old.beside.widened(self.held, self.mean, self.cov)
        return wide

    @property
    def all_ids(self) -> np.ndarray:
        """Ids of all landmarks, including old sub-maps'."""
        return self.ids if self.submap is None else np.union1d(self.ids, self.old.ids)

    def estimate(self, particles: Particles) -> Estimate:
        """The robot's pose in the world, with the particles' spread and the frame's uncertainty."""
        if self.old.maps and not self.passed_on:
            # The current sub-map has re-initialised some landmarks: only here the finished ones' information on them is used.
            return self.old.end(self._consolidated(particles).finished(self.old))
        d, weights, world = self.space.dim, particles.weights, self.world(particles.state)
        origin, turn = self.space.mean(world, weights), self._turn(particles)
        within = self.cov[:d, :d] if self.old.frame is None else self.old.frame.cov
        cov = turn @ within @ turn.T + spread_of(self.space.local(origin, world), weights)
        return Estimate(origin, gaussian.symmetrise(cov))

    def landmarks(self, particles: Particles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Names (M,) of all landmarks, means (M, D) and covariances (M, D, D) in the world."""
        return self._consolidated(particles).landmarks(self.old)

    def moments(self, particles: Particles, of: Part | np.ndarray = Part.LANDMARK) -> tuple[np.ndarray, np.ndarray]:
        """As `Belief.moments`; the substate stays in the robot's frame."""
        if not isinstance(of, Part):
            names, means, covs = self.landmarks(particles)
            rows = {name: row for row, name in enumerate(names.tolist())}
            if missing := [name for name in of.tolist() if name not in rows]:
                raise InputError(f"the map has no landmark {missing[0]}")
            chosen = [rows[name] for name in of.tolist()]
            return means[chosen], covs[chosen]
        if of == Part.STATE:
            pose = self.estimate(particles)
            return pose.mean, pose.cov
        if of == Part.SUBSTATE:
            own = slice(self.space.dim, self._first)
            return gaussian.mixture_moments(particles.weights, self.mean[:, own], self.cov[own, own][None])
        return self.landmarks(particles)[1:]

    def world(self, state: np.ndarray, particles: np.ndarray | slice = slice(None)) -> np.ndarray:
        """World_from_robot (n, E) of some particles, at the mean of each one's frame."""
        if self.old.frame is None:
            return self._from_start(state, particles)
        # The pose of the frame from the sub-maps, constant between consolidations.
        return self.space.compose(self.old.frame.mean, state)

    def _from_start(self, state: np.ndarray, particles: np.ndarray | slice = slice(None)) -> np.ndarray:
        """As `world`, relative to the current sub-map's start."""
        frame = self.space.retract(self.origin, self.mean[particles, : self.space.dim])
        return self.space.compose(frame, state)

    def _consolidated(self, particles: Particles) -> Present:
        """The present sub-map in a frame at the robot, Mathematics (consolidation)."""
        space, weights, state = self.space, particles.weights, particles.state
        d = space.dim
        world = self._from_start(state)
        origin, centre = space.mean(world, weights), space.mean(state, weights)
        # Each particle's means relative to its own robot, and the transformation T of the covariance at their mean.
        before = weighted_mean(self.mean, weights)
        moved = self.mean.copy()
        moved[:, :d] = space.local(origin, world)
        blocks = [(np.arange(d)[None], self._turn(particles)[None])]
        for kind in self.held.by_kind():
            if not kind.landmark.anchored:
                moved[:, kind.columns] = kind.landmark.seen_from(space, state[:, None], self.mean[:, kind.columns])[0]
                blocks.append((kind.columns, kind.landmark.seen_from(space, centre, before[kind.columns])[1]))
        held, clones = copy(self.held), self.held.clones
        if len(clones):
            # Mathematics (clone), with K' relative to the particles' mean pose.
            at = self.held.clone_columns(np.arange(len(clones)))
            poses = space.retract(clones, self.mean[:, at])
            held.clones = clones = space.between(centre, space.retract(clones, before[at]))
            moved[:, at] = space.local(clones, space.between(state[:, None], poses))
        mean = weighted_mean(moved, weights)
        if len(clones):
            blocks.append((at, space.right_jacobian_inverse(mean[at]) @ space.right_jacobian(before[at])))
        mean[:d] = 0.0  # the mean of all worlds is the origin
        cov = plus_gram(turned(self.cov, blocks), apart(moved, weights))
        return Present(origin, held, mean, cov, self._given_ids, self._walked)

    def _turn(self, particles: Particles) -> np.ndarray:
        """Jacobian of the robot's pose by ξ: G Exp(ξ + dξ) y = G Exp(ξ) y Exp(Ad(y⁻¹) J_r(ξ) dξ), (d, d) at the means."""
        centre = self.space.mean(particles.state, particles.weights)
        frame = weighted_mean(self.mean[:, : self.space.dim], particles.weights)
        return self.space.adjoint(self.space.inverse(centre)) @ self.space.right_jacobian(frame)

    def _given(self, increment: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Means (N, n) given increments (N, d), and the covariance; the increment is a measurement of the substate."""
        if self._gain is None or increment is None:
            return self.mean, self.cov
        return self._predicted + (increment - self._increment_mean) @ self._gain.T, self._left()

    def _left(self) -> np.ndarray:
        """The covariance (n, n) given increments, computed lazily: `expected` does not need it."""
        if self._rest is None:
            cov, half = self._before
            self._rest = plus_gram(cov.copy(), half.T, -1.0)
        return self._rest

    def _rows(self, state: np.ndarray, mean: np.ndarray, cov: np.ndarray, groups: Sequence[Observations]) -> Rows:
        if self._reading is None or not self._reading.is_of(self.held, cov, groups):
            self._reading = Reading(self.held, cov, groups, self.compiled)
        return self._reading.rows(groups, state, mean, self.origin if self.submap is None else None)

    def _seen_through(self, state: np.ndarray, groups: Sequence[Observations], prior: Prior) -> Rows:
        """The rows at predicted states; if the increment measures a substate, the map moves with it."""
        increment = None if self._gain is None else self.space.local(prior.base, state)
        rows = self._rows(state, *self._given(increment), groups)
        if increment is None or self._gain is None:
            return rows
        return rows.moving(self._gain, self.space.right_jacobian_inverse(increment))

    def _foreseen(self, groups: Sequence[Observations], belief: Belief) -> tuple[np.ndarray, np.ndarray, list[Group]]:
        """Mean (R,) and covariance (R, R) of the innovations over all particles, and their groups."""
        prior, weights = belief.prior, belief.weights
        rows = self._seen_through(belief.state, groups, prior)
        by_state = rows.said[:, 1:].transpose(2, 0, 1)
        spread = np.einsum("n,nra->ra", weights, by_state @ prior.spread(prior.mean))
        nu = weighted_mean(rows.nu, weights)
        apart = np.sqrt(weights)[:, None] * (rows.nu - nu)
        return nu, plus_gram(rows.cov, np.concatenate([spread.T, apart])), rows.groups

    @property
    def ids(self) -> np.ndarray:
        return self.held.table.ids[self.held.table.ids >= 0]

    @property
    def stored_fraction(self) -> float:
        sizes = np.array([kind.dim * (kind.dim + 3) // 2 for kind in self.held.kinds])
        return (self.mean.nbytes + self.cov.nbytes) / max(8 * self.n * int(sizes[self.held.table.kind].sum()), 1)

    def holds(self, ids: np.ndarray) -> np.ndarray:
        return self.held.holds(ids)

    def landmark_of(self, landmark_id: int) -> Landmark:
        return self.held.kinds[self.held.table.kind[self.held.rows_of(np.array([landmark_id]))[0]]]

    def are(self, ids: np.ndarray, landmark: Landmark) -> np.ndarray:
        held, number = self.holds(ids), self.held.number(landmark)
        held[held] = self.held.table.kind[self.held.rows_of(np.asarray(ids)[held])] == number
        return held

    def read(self, ids: np.ndarray, particles: np.ndarray | slice = slice(None)) -> Records:
        """Means and covariances in the frame; for anchored landmarks in the anchor's, whose clone is the constant."""
        kind = self.held.of_one_kind(np.asarray(ids))
        own = self.mean[particles]
        mean, blocks = own[:, kind.columns], diagonal_blocks(self.cov, kind.columns)
        const = None
        if kind.landmark.anchored:
            const = self.held.poses(kind, own)
        return Records(mean, np.broadcast_to(blocks, (*mean.shape, mean.shape[-1])), const)

    def add(self, new_landmarks: NewLandmarks, state: np.ndarray) -> np.ndarray:
        if new_landmarks.mask is not None and not new_landmarks.mask.all():
            raise InputError("a joint map's landmarks exist in all particles")
        model, z, own = new_landmarks.model, new_landmarks.z, slice(self.space.dim, self._first)
        records = self.first_records(new_landmarks, state)
        ids = self.add_records(records, new_landmarks.landmark, None, new_landmarks.ids)
        slope = model.new_by_substate(z)
        if slope is not None and model.about is not None:
            if not new_landmarks.landmark.anchored:
                centre, middle = self.space.mean(state, np.full(self.n, 1.0 / self.n)), records.mean.mean(axis=0)
                slope = np.linalg.solve(new_landmarks.landmark.seen_from(self.space, centre, middle)[1], slope)
            by_own = slope.reshape(-1, slope.shape[-1])
            last = slice(len(self.cov) - len(by_own), None)  # their columns
            self.mean[:, last] += (self.mean[:, own] - model.about) @ by_own.T
            self.cov[last] += by_own @ self.cov[own]
            self.cov[:, last] += self.cov[:, own] @ by_own.T
        return ids

    def add_records(
        self, records: Records, landmark: Landmark, log_odds: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> np.ndarray:
        """As `Map.add_records`; the anchor poses of anchored landmarks become clones."""
        if log_odds is not None:
            raise InputError("a joint map's landmarks exist in all particles")
        self.register(landmark)
        if not (np.isfinite(records.mean).all() and np.isfinite(records.cov).all()):
            raise InputError("a new landmark has a mean or covariance that is not finite")
        count, dim, d = records.mean.shape[1], landmark.dim, self.space.dim
        ids = self.checked_new_ids(ids, count, self._next_id)
        if not landmark.anchored:
            self._reach = max(self._reach, float(np.linalg.norm(records.mean[0], axis=-1).max(initial=0.0)))
        # Given the path, a new landmark's error is that of its measurement alone, and a clone of the path has none.
        mean = np.broadcast_to(records.mean, (self.n, count, dim)).reshape(self.n, -1)
        clone, origins, places = np.full(count, -1), np.zeros((0, self.space.size)), np.zeros((self.n, 0, d))
        if landmark.anchored:
            assert records.const is not None
            anchors = np.broadcast_to(records.const, (self.n, count, self.space.size))
            _, which, clone = np.unique(anchors, axis=1, return_index=True, return_inverse=True)
            clone = clone.reshape(-1)
            origins = anchors[0, which]
            places = self.space.local(origins, anchors[:, which])
        old, grown = self.mean.shape[1], self.mean.shape[1] + places.shape[1] * d + mean.shape[1]
        if grown > LARGEST:
            most = (LARGEST - self._first) // self.point.dim
            raise InputError(f"a joint map holds at most {most} landmarks: use per-particle maps (map=particles)")
        self.mean = np.concatenate([self.mean, places.reshape(self.n, -1), mean], axis=1)
        cov = np.empty((grown, grown))
        cov[:old, :old], cov[old:], cov[:old, old:] = self.cov, 0.0, 0.0
        columns = self.held.add(ids, landmark, clone, origins)
        cov[columns[:, :, None], columns[:, None, :]] = records.cov.mean(axis=0)
        self.cov = cov
        self._next_id = max(self._next_id, int(ids.max(initial=-1)) + 1)
        return ids

    def register(self, landmark: Landmark) -> None:
        """Registers a parametrisation before its first use, so that a checkpoint can be loaded.

        The saving and the loading filter must register the same ones in the same order. Raises InputError: it has several
        components, constants that are not an anchor, or no `seen_from`.
        """
        if self.held.number(landmark) >= 0:
            return
        space, anchor = self.space, self.space.identity() if landmark.anchored else None
        fits = landmark.components == 1 and landmark.constants == (0 if anchor is None else space.size)
        if not fits or landmark.point(np.zeros(landmark.dim), anchor)[0].shape != (self.point.dim,):
            raise InputError(
                f"a joint map of {space} holds Point({self.point.dim}), or anchored landmarks, in all particles, "
                f"not {type(landmark).__name__}"
            )
        landmark.seen_from(space, space.identity(), np.zeros(landmark.dim))
        self.held.kinds.append(landmark)

    def remove(self, ids: np.ndarray) -> None:
        if len(ids):
            self.old.forget(ids)
            self._given_ids = np.setdiff1d(self._given_ids, ids)
            self._keep(self.held.drop(self.held.rows_of(ids)))

    def _keep(self, columns: np.ndarray) -> None:
        self.mean, self.cov = self.mean[:, columns], principal(self.cov, columns)

    def promote(self, ids: Sequence[int] | np.ndarray, to: Landmark | None = None) -> None:
        """Converts anchored landmarks to points in the frame, with their correlations, to first order.

        Their mean is that of the landmark's own transform: the mean of 1/q is not 1/q̄, which would place all landmarks
        promoted as early as possible too near.
        """
        ids = np.asarray(ids, dtype=np.int64)
        if not ids.size:
            return
        kind = self.held.of_one_kind(ids)
        if not kind.landmark.anchored or self.held.number(to or self.point) != 0 or kind.landmark.dim != self.point.dim:
            raise InputError(f"a joint map promotes anchored landmarks to Point({self.point.dim})")
        points, slopes = kind.landmark.promote(self.read(ids)).mean, self.held.points(kind, self.mean)[1]
        slope, columns = slopes.mean(axis=0), np.concatenate([kind.columns, kind.clones], axis=1)
        # P' = T P Tᵀ, where T has the Jacobian in the rows of each landmark.
        for _ in range(2):
            self.cov[kind.columns] = slope @ self.cov[columns]
            self.cov = self.cov.T
        self.cov = gaussian.symmetrise(self.cov)
        self.mean[:, kind.columns] = points
        kinds, clones = self.held.table.kind.copy(), self.held.table.clone.copy()
        kinds[kind.rows], clones[kind.rows] = 0, -1
        self.held.hold(self.held.table._replace(kind=kinds, clone=clones))
        self._keep(self.held.drop(kind.rows[:0]))

    def loosen(self, ids: np.ndarray, cov: np.ndarray) -> None:
        """Adds process noise (K, D, D) to the positions of landmarks (K,) in the frame, independently."""
        columns = self.held.of_one_kind(ids).columns
        self.cov = self.cov.copy()
        for held in [self.cov] if self._gain is None else [self.cov, self._left()]:
            held[columns[:, :, None], columns[:, None, :]] += cov
        turn = self.space.rotation(self._from_start(self.space.identity(), np.arange(1))[0])
        walked = zip(ids.tolist(), np.broadcast_to(turn @ cov @ turn.T, (ids.size, *turn.shape)), strict=True)
        self._walked = self._walked | {name: self._walked.get(name, 0.0) + by for name, by in walked}

    def log_odds(self, ids: np.ndarray) -> np.ndarray:
        return np.zeros((self.n, ids.size))

    def set_log_odds(self, ids: np.ndarray, log_odds: np.ndarray) -> None:
        raise InputError("a joint map has no log-odds")

    def expected(self, model: ObservationModel, ids: np.ndarray, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
        kind, prior = self.held.of_one_kind(np.asarray(ids)), belief.prior
        kernel = self.held.kernel(model, kind) if self.compiled else None
        if kernel is None:
            return super().expected(model, ids, belief)
        predicted = np.empty((self.n, len(kind.rows), model.dim))
        within, held = np.empty((*predicted.shape, model.dim)), (kind.columns, kind.clones, kind.origins)
        arrays = belief.state, self.mean, self.cov, prior.spread(prior.mean)
        state, mean, cov, root = (numbers(each, "what a kernel takes") for each in arrays)
        expect_group(kernel.function.address, kernel.params, state, mean, *held, cov, root, predicted, within)
        return predicted, within

    def project_jointly(self, model: ObservationModel, ids: np.ndarray, belief: Belief) -> tuple[Array, Array]:
        """`project` with cross-covariances of the landmarks: mean (K, p) and covariance (K p, K p)."""
        mode = slice(belief.mode, belief.mode + 1)
        records = self.read(ids, mode)
        z = model.predict(belief.state[mode, None], records.mean, records.const)[0]
        nu, cov, _ = self._foreseen([Observations(z, np.zeros((*z.shape, z.shape[1])), model, ids=ids)], belief)
        return z - nu.reshape(z.shape), cov

    def expected_alone(self, model: ObservationModel, belief: Belief, ids: np.ndarray) -> tuple[Array, Array]:
        """`project_jointly` without cross-covariances: mean (K, p) and covariance (K, p, p)."""
        mean, cov = self.project_jointly(model, ids, belief)
        return mean, diagonal_blocks(cov, np.arange(mean.size).reshape(mean.shape))

    def arrays(self) -> dict[str, np.ndarray]:
        named = {"mean": self.mean, "cov": self.cov.copy(), "origin": self.origin, "next": np.array([self._next_id])}
        named = {f"joint/{name}": array for name, array in (named | self.held.arrays()).items()}
        if self.submap is None:
            return named
        waiting = {"given": self._given_ids, "leaving": self.leaving, "returning": self._returning}
        named["joint/walked_ids"] = np.array(list(self._walked), dtype=np.int64)
        named["joint/walked"] = np.array(list(self._walked.values())).reshape(-1, self.point.dim, self.point.dim)
        if not self.passed_on:
            named["joint/reach"] = np.array([self._reach])
        return named | {f"joint/{name}": array for name, array in waiting.items()} | self.old.arrays()

    def options(self) -> dict[str, object]:
        kinds = [type(kind).__name__ for kind in self.held.kinds]
        return {"joint substate": self._first - self.space.dim, "joint kinds": kinds, "submap": self.submap}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        schema = {
            "mean": checkpoint.numbers("n", "size"), "cov": checkpoint.numbers("size", "size"),
            "origin": checkpoint.elements(self.space), "next": checkpoint.integers(1, least=0),
        }  # fmt: skip
        if self.submap is not None:
            dim = self.point.dim
            schema |= {name: checkpoint.integers(f"{name} ids") for name in ("given", "leaving", "returning")}
            schema |= {"walked_ids": checkpoint.integers("walked"), "walked": checkpoint.numbers("walked", dim, dim)}
            if not self.passed_on:
                schema["reach"] = checkpoint.numbers(1)
        found = checkpoint.read(arrays, schema, "joint/", n=self.n)
        self.mean, self.cov, self.origin = found["mean"], found["cov"], found["origin"]
        self.held.restore(arrays, "joint/", self.mean.shape[1])
        self._next_id = int(found["next"][0])
        if np.unique(self.ids).size < self.ids.size or self.ids.max(initial=-1) >= self._next_id:
            raise InputError("the array joint/ids has a landmark twice, or one that never existed")
        if self.submap is not None:
            self.old.restore(arrays)
            self._given_ids, self.leaving, self._returning = found["given"], found["leaving"], found["returning"]
            self._walked = dict(zip(found["walked_ids"].tolist(), found["walked"], strict=True))
            self._reach = float(found["reach"][0]) if "reach" in found else 0.0
            if not np.isin(self._given_ids, self.old.about.ids).all():
                raise InputError("the array joint/given has a landmark that is not around the start of the sub-map")
