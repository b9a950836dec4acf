"""Motion by odometry, of wheels or of a camera: each control is a measured increment with its covariance."""

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from rbpf import gaussian
from rbpf.core.models import MotionModel, Transition
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, LieGroup

#: Of [ω, v] of a camera: rotation about its y axis, which points down, and translation along x and z.
CAMERA_PLANE = (False, True, False, True, False, True)


@dataclass(frozen=True)
class Odometry:
    """An increment previous_robot_from_robot (E,), and its covariance (d, d) in the right chart there."""

    delta: np.ndarray
    cov: np.ndarray
    #: (d, k) derivative of the increment, in that chart, by the constants of an `OdometryMotion` that has some, see
    #: `wheel_errors`; None if it does not depend on them.
    by_constants: np.ndarray | None = None

    @classmethod
    def at_rest(cls, space: LieGroup = SE3) -> "Odometry":
        """No motion, with zero covariance."""
        return cls(space.identity(), np.zeros((space.dim, space.dim)))

    def then(self, later: "Odometry", space: LieGroup = SE3, cross: np.ndarray | None = None) -> "Odometry":
        """The composition of two motions: C = Ad⁻¹ C₁ Ad⁻ᵀ + C₂ + Ad⁻¹ X + Xᵀ Ad⁻ᵀ with Ad of `later`.

        Mathematics (chain). `cross` is X (d, d) = E[ξ₁ ξ₂ᵀ] of the errors ξ in the right charts; None for independent ones.
        """
        back = space.adjoint(space.inverse(later.delta))
        cov = back @ self.cov @ back.T + later.cov
        if cross is not None:
            cov = cov + back @ cross + (back @ cross).T
        return Odometry(space.compose(self.delta, later.delta), gaussian.symmetrise(cov))


def preintegrate(
    ticks: np.ndarray, cov: np.ndarray, by_bias: np.ndarray, space: LieGroup = SE3
) -> tuple[Odometry, np.ndarray]:
    """Preintegrates high-rate wheel and gyroscope increments between two frames (T. Lupton, S. Sukkarieh 2012).

    The motion is Π Exp(tick + by_bias b + noise) at b = 0, with the bias b common to all ticks: a small b changes the
    motion by Exp(B b) on the right.

    Args:
        ticks: (K, d) increments, in the chart [ω, v] of `space`.
        cov: (d, d) noise covariance of each.
        by_bias: (d, k) derivative of each by b; −dt in the row of ω for a gyroscope bias.
        space: SE2, SE3 or any group.

    Returns: the motion, and its derivative B (d, k), in the right chart there.
    """
    motion, derivative = Odometry.at_rest(space), np.zeros_like(by_bias, dtype=float)
    for tick in ticks:
        step, jac = space.exp(tick), space.right_jacobian(tick)
        motion = motion.then(Odometry(step, jac @ cov @ jac.T), space)
        derivative = space.adjoint(space.inverse(step)) @ derivative + jac @ by_bias
    return motion, derivative


@final
class OdometryMotion(MotionModel):
    """x_t = x_{t−1} · delta · Exp(w), w ~ N(0, cov + diag(std_added²)). Without a control the robot stands still.

    Args:
        space: SE2, SE3 or any group.
        std_added: standard deviation of noise added per step, one number or (d,) in the order of the tangent. S05 §V adds
            some and gives no figure; the default is none, so that covariances can be tested for consistency.
        free: (d,) bool: the components of Log(delta) and of the noise that are kept; the others are dropped. `CAMERA_PLANE`
            keeps a camera in the x–z plane of its first pose (S05). None keeps all.
        constants: number k of constant substate parameters, such as a calibration, see `Odometry.by_constants`.
    """

    def __init__(
        self, space: LieGroup, std_added: ArrayLike = 0.0, free: tuple[bool, ...] | None = None, constants: int = 0
    ) -> None:
        self.space, self.constants = space, constants
        self.cov_added = np.diag(deviations(std_added, space.dim, "std_added") ** 2)
        self._free = None if free is None else np.diag(np.asarray(free, dtype=float))

    def transition(self, state: np.ndarray, control: Odometry | None, dt: float) -> Transition:
        """The increment, the same for all particles. Raises InputError: it is not finite, or its covariance is invalid."""
        d = self.space.dim
        if control is None:
            return self._with_constants(state, np.zeros((d, d)), None)
        if control.delta.shape != (self.space.size,) or control.cov.shape != (d, d):
            raise InputError(
                f"odometry needs delta ({self.space.size},) and cov ({d}, {d}), "
                f"got {control.delta.shape} and {control.cov.shape}"
            )
        if not np.isfinite(control.delta).all():
            raise InputError(f"the odometry increment {control.delta} holds NaN or infinity")
        moved = self.constrained(control)
        try:
            factor = gaussian.psd_factor(moved.cov)
        except InputError as error:
            raise InputError(f"the covariance of the odometry is not valid: {error}") from error
        return self._with_constants(self.space.compose(state, moved.delta), factor, moved.by_constants)

    def _with_constants(self, mean: np.ndarray, factor: np.ndarray, coupling: np.ndarray | None) -> Transition:
        k = self.constants
        if not k:
            return Transition(mean, factor[None])
        if coupling is None:
            coupling = np.zeros((self.space.dim, k))
        factor = np.concatenate([factor, np.zeros((k, factor.shape[1]))])
        return Transition(mean, factor[None], coupling[None], np.eye(k)[None], np.zeros((1, k)))

    def constrained(self, measured: Odometry) -> Odometry:
        """A measured increment and its covariance, reduced to the `free` components and with `std_added`."""
        cov, by_constants = measured.cov + self.cov_added, measured.by_constants
        if self._free is None:
            return Odometry(measured.delta, cov, by_constants)
        delta = self.space.exp(self._free @ self.space.log(measured.delta))
        by_constants = None if by_constants is None else self._free @ by_constants
        return Odometry(delta, self._free @ cov @ self._free, by_constants)


def wheel_errors(delta: np.ndarray) -> np.ndarray:
    """Derivative (…, 3, 4) of an increment (…, 3) in the plane by four constant (systematic) odometry errors.

    In the chart at its end, in this order: heading error per metre driven forward [rad/m], from wheels of unequal size or a
    biased steering angle; heading error as a fraction of left turns and of right turns, from a wrong track width or
    steering ratio (J. Borenstein and L. Feng 1996); position error as a fraction of the distance, from a wrong wheel
    radius.
    """
    log, by_errors = SE2.log(delta), np.zeros((*np.shape(delta), 4))
    by_errors[..., 0, 0] = log[..., 1]
    by_errors[..., 0, 1], by_errors[..., 0, 2] = np.maximum(log[..., 0], 0.0), np.minimum(log[..., 0], 0.0)
    by_errors[..., 1:, 3] = -SE2.translation(SE2.inverse(delta))
    return by_errors


def deviations(std: ArrayLike, dim: int, name: str) -> np.ndarray:
    """Standard deviations (dim,), from one for all or one each. Raises InputError: one is negative or not finite."""
    array = np.asarray(std, dtype=float)
    if array.shape not in ((), (dim,)) or not (np.isfinite(array).all() and (array >= 0.0).all()):
        raise InputError(f"{name} must be one or {dim} numbers from 0 up, got {std!r}")
    return np.broadcast_to(array, (dim,)).copy()
