"""Motion by odometry: each control is a measured increment with its covariance."""

from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import MotionModel, Transition
from rbpf.errors import InputError
from rbpf.lie import LieGroup


@dataclass(frozen=True)
class Odometry:
    """An increment previous_robot_from_robot (E,), and its covariance (d, d) in the right chart there."""

    delta: np.ndarray
    cov: np.ndarray


@final
class OdometryMotion(MotionModel):
    """x_t = x_{t−1} · delta · Exp(w), w ~ N(0, cov). Without a control the robot stands still.

    Args:
        space: SE2, SE3 or any group.
    """

    def __init__(self, space: LieGroup) -> None:
        self.space = space

    def transition(self, state: np.ndarray, control: Odometry | None, dt: float) -> Transition:
        """The increment, the same for all particles."""
        d = self.space.dim
        if control is None:
            return Transition(state, np.zeros((1, d, d)))
        if control.delta.shape != (self.space.size,) or control.cov.shape != (d, d):
            raise InputError(
                f"odometry needs delta ({self.space.size},) and cov ({d}, {d}), "
                f"got {control.delta.shape} and {control.cov.shape}"
            )
        if not np.isfinite(control.delta).all():
            raise InputError(f"the odometry increment {control.delta} holds NaN or infinity")
        try:
            factor = gaussian.psd_factor(control.cov)
        except InputError as error:
            raise InputError(f"the covariance of the odometry is not one: {error}") from error
        return Transition(self.space.compose(state, control.delta), factor[None])
