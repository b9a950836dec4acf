"""Smoothed trajectories: along ancestors, with a fixed lag, and by backward simulation for models without a map."""

from dataclasses import dataclass

import numpy as np

from rbpf import gaussian
from rbpf.core.genealogy import History
from rbpf.core.models import MotionModel, draws
from rbpf.errors import InputError
from rbpf.lie import Array, LieGroup


@dataclass(frozen=True)
class Smoothed:
    """A smoothed trajectory: stamps (T,), means (T, E), covariances (T, d, d) in the charts at the means."""

    stamps_ns: np.ndarray
    mean: np.ndarray
    cov: np.ndarray


def ancestral_smoothing(space: LieGroup, history: History, weights: np.ndarray) -> Smoothed:
    """p(x_t | z_1:T) from the ancestors of the current particles with weights (N,); fixed-lag if the history has a lag."""
    return _summary(space, history.stamps_ns, history.paths(), weights)


def backward_simulation(
    motion: MotionModel, history: History, count: int, rng: np.random.Generator, controls: list[object] | None = None
) -> Smoothed:
    """p(x_t | z_1:T) from `count` trajectories drawn backwards through stored clouds.

    S. Godsill, A. Doucet, M. West, "Monte Carlo smoothing for nonlinear time series" (2004). For models without a
    marginalised part: with a map the backward weight would depend on all future observations of every landmark.

    Args:
        motion: the filter's motion model; its noise covariance must be regular.
        history: made with clouds=True and without a lag.
        count: number of trajectories.
        rng: source of randomness.
        controls: control of each step; entry t leads from t−1 to t.

    Raises InputError: the history holds no clouds, or the motion has a substate or singular noise.
    """
    if not history.clouds or history.lag is not None:
        raise InputError("backward simulation needs stored clouds: build the filter with clouds=True and no lag")
    clouds = [states for block in history.blocks for states in block.states]
    log_weights = [weights for block in history.blocks for weights in block.log_weights]
    stamps = history.stamps_ns
    chosen = _draw(np.repeat(log_weights[-1][None], count, axis=0), rng)
    paths = [clouds[-1][chosen]]
    for t in range(len(clouds) - 2, -1, -1):
        control = None if controls is None else controls[t + 1]
        log_density = _transition_log_density(motion, clouds[t], paths[0], control, (stamps[t + 1] - stamps[t]) * 1e-9)
        paths.insert(0, clouds[t][_draw(log_weights[t] + log_density, rng)])
    return _summary(motion.space, stamps, np.array(paths), np.full(count, 1.0 / count))


def _transition_log_density(motion: MotionModel, before: Array, after: Array, control: object, dt: float) -> Array:
    """Log p(after_j | before_i) up to terms independent of i, (J, N): Mathematics (backward)."""
    density = motion.log_density(before, after, control, dt)
    if density is not None:
        return density
    if draws(motion):
        raise InputError(f"backward simulation needs a density of {type(motion).__name__}.sample: override log_density")
    transition = motion.transition(before, control, dt)
    if transition.coupling is not None and transition.coupling.shape[-1]:
        raise InputError("backward simulation takes motion models without a substate")
    factor = transition.noise_factor
    if (np.linalg.matrix_rank(factor) < motion.space.dim).any():
        raise InputError("backward simulation needs a motion model with regular noise")
    increment = motion.space.local(transition.mean[None], after[:, None])
    chart = np.linalg.slogdet(motion.space.right_jacobian_inverse(increment))[1]
    return gaussian.log_density(increment, gaussian.gram(factor)) + chart


def _draw(log_weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One index per row of log-weights (J, N)."""
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    cdf = np.cumsum(weights, axis=1)
    return (cdf < rng.random((cdf.shape[0], 1)) * cdf[:, -1:]).sum(axis=1)


def _summary(space: LieGroup, stamps_ns: np.ndarray, paths: np.ndarray, weights: np.ndarray) -> Smoothed:
    means = np.array([space.mean(states, weights) for states in paths])
    spread = space.local(means[:, None], paths)
    return Smoothed(stamps_ns, means, np.einsum("n,tna,tnb->tab", weights, spread, spread))
