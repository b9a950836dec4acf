"""Constant velocity on SE(3), driven by white-noise acceleration (E06 §3.1).

    T_t = T_{t−1} Exp(δ v_{t−1} + w₁),   v_t = v_{t−1} + w₂,   cov(w₁, w₂) = Q of E06 (5), Mathematics (velocity-noise)

The velocity v = [ω, v] is that of the body in its own frame. E06 writes camera_from_world with the exponential on the
left: the same motion, with the sign of v reversed.
"""

from dataclasses import dataclass
from typing import Literal, final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import MotionModel, Transition
from rbpf.errors import InputError
from rbpf.lie import SE3, Euclidean, Product
from rbpf.motion.odometry import deviations

#: State (N, 13) of `SampledVelocity`: world_from_body, then its velocity.
POSE_AND_VELOCITY = Product(SE3, Euclidean(6))


@dataclass(frozen=True)
class PosePrior:
    """Given as control: resets the pose to this distribution, whatever it was before (at the start, or after a kidnapping)."""

    mean: np.ndarray  #: (7,) world_from_body, or (N, 7), one per particle.
    cov: np.ndarray  #: (6, 6) in the right chart at the mean, order [ω, v].
    #: (6,) standard deviation of the velocity about zero, rad/s, m/s; None keeps the velocity as it was.
    std_velocity: np.ndarray | None = None


def velocity_walk(std_walk: np.ndarray, dt: float) -> np.ndarray:
    """Factor L (12, 12) of E06 (5), Q = L Lᵀ, Mathematics (velocity-factor); the first six columns carry the pose noise.

    The last six carry the variance δΣ/4 of the velocity given the pose. `std_walk` (6,) is σ of E06 (4), the standard
    deviation of the velocity's random walk over one second, (rad/s, m/s)/√s; `dt` is δ, seconds.
    """
    sigma = np.diag(std_walk)
    factor = np.zeros((12, 12))
    factor[:6, :6] = np.sqrt(dt**3 / 3.0) * sigma
    factor[6:, :6] = np.sqrt(0.75 * dt) * sigma
    factor[6:, 6:] = 0.5 * np.sqrt(dt) * sigma
    return factor


@final
class MarginalVelocity(MotionModel):
    """The velocity as a Kalman substate: the filter needs `KalmanSubstate(SE3, mean, cov)` with six numbers.

    Exact: Log(T_{t−1}⁻¹ T_t) = δ v_{t−1} + w₁ is a linear measurement of the velocity.

    Args:
        std_walk: (6,) or a number, see `velocity_walk`.
        constants: how many constant parameters follow the six of the velocity in the substate; they do not move the body.
    """

    space = SE3

    def __init__(self, std_walk: np.ndarray, constants: int = 0) -> None:
        self.std_walk = deviations(std_walk, 6, "std_walk")
        self.constants = constants

    def transition(self, state: np.ndarray, control: PosePrior | None, dt: float) -> Transition:
        """Chart at the previous pose: ε = δ v + w₁."""
        coupling, factor = dt * np.eye(6)[None], velocity_walk(self.std_walk, dt)
        keeps = np.eye(6)[None]
        if control is not None:
            state, factor = _reset_pose(state, control), _with_prior(factor, control)
            coupling = np.zeros((1, 6, 6))
            keeps = keeps if control.std_velocity is None else np.zeros((1, 6, 6))
        if k := self.constants:
            factor, coupling = np.pad(factor, ((0, k), (0, 0))), np.pad(coupling, ((0, 0), (0, 0), (0, k)))
            keeps = np.pad(keeps, ((0, 0), (0, k), (0, k)))
            keeps[0, 6:, 6:] = np.eye(k)
        return Transition(state, factor[None], coupling, keeps, np.zeros((1, 6 + k)))


@final
class SampledVelocity(MotionModel):
    """The velocity sampled with the pose, states (N, 13) of `POSE_AND_VELOCITY`.

    Args:
        std_walk: (6,) or a number, see `velocity_walk`.
        mode: "joint" samples all twelve dimensions; "paper" moves the velocity to its conditional mean given the
            sampled pose, v ← v + (3/2δ) w₁ (E06 §3.1), and drops the variance δΣ/4 around it.
        std_start: (6,) or a number, standard deviation of the velocity after a `PosePrior` that keeps it, rad/s, m/s.
    """

    space = POSE_AND_VELOCITY

    def __init__(
        self, std_walk: np.ndarray, mode: Literal["paper", "joint"] = "joint", std_start: np.ndarray | float = 0.0
    ) -> None:
        self.std_walk = deviations(std_walk, 6, "std_walk")
        self.std_start = deviations(std_start, 6, "std_start")
        if mode not in ("paper", "joint"):
            raise InputError(f"a sampled velocity has the mode 'paper' or 'joint', got {mode!r}")
        self.columns = 6 if mode == "paper" else 12

    def transition(self, state: np.ndarray, control: PosePrior | None, dt: float) -> Transition:
        """Chart at (T Exp(δv), v): T Exp(δv + w₁) = T Exp(δv) Exp(J_r(δv) w₁) to first order."""
        placed, velocity = state[:, :7], state[:, 7:]
        if control is not None:
            stopped = control.std_velocity is not None
            mean = np.concatenate([_reset_pose(placed, control), 0.0 * velocity if stopped else velocity], axis=1)
            factor = _with_prior(np.zeros((12, 12)), control)
            if not stopped:
                factor[6:, 6:] = np.diag(self.std_start)
            return Transition(mean, factor[None])
        step = dt * velocity
        factor = np.repeat(velocity_walk(self.std_walk, dt)[None, :, : self.columns], state.shape[0], axis=0)
        factor[:, :6] = SE3.right_jacobian(step) @ factor[:, :6]
        return Transition(np.concatenate([SE3.retract(placed, step), velocity], axis=1), factor)


def _reset_pose(state: np.ndarray, prior: PosePrior) -> np.ndarray:
    if prior.mean.shape not in ((7,), state.shape) or prior.cov.shape != (6, 6) or not np.isfinite(prior.mean).all():
        raise InputError(f"a PosePrior needs a finite mean (7,) and cov (6, 6), got {prior.mean} and {prior.cov.shape}")
    return np.broadcast_to(SE3.normalise(prior.mean), state.shape).copy()


def _with_prior(factor: np.ndarray, prior: PosePrior) -> np.ndarray:
    """The noise factor (12, 12) with the prior's pose covariance, independent of the velocity's noise."""
    walk = np.linalg.norm(factor[6:], axis=1)
    placed = np.zeros((12, 12))
    placed[:6, :6] = gaussian.psd_factor(prior.cov)
    placed[6:, 6:] = np.diag(walk if prior.std_velocity is None else deviations(prior.std_velocity, 6, "std_velocity"))
    return placed
