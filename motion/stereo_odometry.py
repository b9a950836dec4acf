"""Visual odometry as a motion model: its covariance is the noise (S05 §III-C)."""

from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.core.models import MotionModel, Transition
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry, OdometryMotion

PLANAR = np.diag([0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
"""Of [ω, v]: the turn about the camera's y axis, which points down, and the shift along x and z."""


@final
class StereoOdometry(MotionModel):
    """x_t = x_{t−1} · delta · Exp(w), w ~ N(0, cov + diag(std_added²)). Without a control the camera stands still.

    The control is `OdometerStep.odometry`. With three degrees of freedom the other three components of Log(delta) and
    of the noise are dropped, as in the paper: particles stay in the x–z plane of the first camera.

    Args:
        dof: 6, or 3 for a camera that moves in its x–z plane and turns about y.
        std_added: (6,) standard deviation of noise injected per step, order [ω, v] (rad, m), or one number for all.
            S05 §V injects some and names no figure; none is the default, for the covariance is tested.

    Raises:
        InputError: dof is neither, or std_added is negative, not finite, or not of six numbers.
    """

    space = SE3

    def __init__(self, dof: Literal[3, 6] = 6, std_added: ArrayLike = 0.0) -> None:
        if dof not in (3, 6):
            raise InputError(f"stereo odometry has dof 3 or 6, got {dof!r}")
        std = np.asarray(std_added, dtype=float)
        if std.shape not in ((), (6,)) or not (np.isfinite(std).all() and (std >= 0.0).all()):
            raise InputError(f"std_added must be one or six numbers from 0 up, got {std_added!r}")
        self.dof = dof
        self.cov_added = np.diag(np.broadcast_to(std, 6) ** 2)
        self._motion = OdometryMotion(SE3)

    def transition(self, state: np.ndarray, control: Odometry | None, dt: float) -> Transition:
        """The increment, the same for all particles."""
        return self._motion.transition(state, control and self.law(control), dt)

    def law(self, measured: Odometry) -> Odometry:
        """The increment and the covariance that particles are moved by, of a measured one."""
        cov = measured.cov + self.cov_added
        if self.dof == 6:
            return Odometry(measured.delta, cov)
        return Odometry(SE3.exp(PLANAR @ SE3.log(measured.delta)), PLANAR @ cov @ PLANAR)
