"""A robot that calibrates itself: where its sensor is, and what its wheels get wrong, as constants of the joint map."""

from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, numbers, truths
from rbpf.core.diagnostics import Correction
from rbpf.core.filter import Filter
from rbpf.core.models import Part
from rbpf.errors import InputError
from rbpf.lie import SE2Group, SE3Group
from rbpf.maps.joint.solution import Constants
from rbpf.maps.joint_map import JointMap
from rbpf.motion.odometry import Odometry, wheel_errors
from rbpf.sensors.range_bearing import RigidPointModel
from rbpf.systems.range_bearing.config import RangeBearingConfig

DECISIVE = 6.0
"""Standard deviations by which observations are off to one side of what the wheels say when that is no chance any more."""
AS_GOOD_AS_KNOWN = 1e-4
"""How uncertain it is before, as a fraction of what it is then."""


@final
class RobotCalibration(Kept):
    """Constants (m,) of a joint map: coordinates of the sensor's place, then `wheel_errors`, whichever are uncertain.

    By default (`calibrate=auto`) they are as good as known until a score test, Mathematics (wheel-score), says otherwise.
    `is_possible` is whether the map is a joint one of landmarks with names. Raises InputError: what is asked for by name is
    not possible, or leaves nothing to estimate.
    """

    kept: ClassVar = {"score": numbers(3, "learnt"), "_before": numbers("dim", "learnt"), "is_estimated": truths()}
    prefix = "calibration/"

    def __init__(
        self, config: RangeBearingConfig, space: SE2Group | SE3Group, model: RigidPointModel, is_possible: bool
    ) -> None:
        is_asked = config.calibrate not in ("auto", "off")
        std = config.uncertain(space) if is_possible else np.zeros(space.dim + 4)
        if is_asked and not is_possible:
            raise InputError(
                f"calibrate={config.calibrate} takes a joint map of landmarks with names: leave out map=particles, lag and "
                "association=ml"
            )
        if is_asked and not std.any():
            raise InputError(
                f"calibrate={config.calibrate} leaves nothing to estimate: ask for calibrate=sensor in space, and for a "
                "self_calibration above 0"
            )
        self.space, self.model = space, model
        self.learnt = np.flatnonzero(std)  #: (m,) which of all (d + 4,) are uncertain.
        self.free = np.eye(space.dim, std.size)[:, self.learnt]  #: (d, m) how the sensor's place moves with them.
        self.is_estimated = is_asked
        #: Its sum, the variance that right wheels have of it, and the sum of squares.
        self.score = np.zeros((3, self.learnt.size))
        self._before = np.zeros((space.dim, self.learnt.size))  # how the odometry of the last step moves with them
        self._cov = np.diag(std[self.learnt] ** 2)
        scale = 1.0 if is_asked else AS_GOOD_AS_KNOWN
        self.prior = np.zeros(self.learnt.size), scale**2 * self._cov

    def driven(self, odometry: Odometry | None) -> Odometry | None:
        """The odometry, which says how it moves with them; as it is if it is no increment: the motion model refuses it."""
        wheels = self.learnt >= self.space.dim
        if odometry is None or not wheels.any() or np.shape(odometry.delta) != (self.space.size,):
            return odometry
        if not np.isfinite(odometry.delta).all():
            return odometry
        by_constants = np.zeros((self.space.dim, self.learnt.size))
        by_constants[:, wheels] = wheel_errors(odometry.delta)[:, self.learnt[wheels] - self.space.dim]
        return replace(odometry, by_constants=by_constants)

    def tuned(self, filter_: Filter) -> RigidPointModel:
        """The sensor where the particles have it on average."""
        if not self.free.any():
            return self.model
        own = filter_.marginals.driving()
        assert own is not None
        return self.model.tuned(filter_.particles.weights @ own, self.free)

    def watch(self, filter_: Filter, odometry: Odometry, factor: np.ndarray, found: Correction | None) -> bool:
        """Tests a step by odometry, by what was found about its noise, whose covariance has a factor (d, r).

        Whether what the wheels get wrong is estimated from here on, and was not before.
        """
        if self.is_estimated or odometry.by_constants is None or found is None:
            return False
        # Of the step before: what the odometry says now has its own noise in it, which is what was found.
        whitened = np.linalg.lstsq(factor, self._before)[0]
        self._before = odometry.by_constants
        score, variance = whitened.T @ found.mean, np.einsum("ac,ab,bc->c", whitened, found.cov, whitened)
        self.score += score, np.maximum(variance, 0.0), score**2
        self.is_estimated = bool((self.score[0] ** 2 > DECISIVE**2 * self.score[1:].max(axis=0)).any())
        if self.is_estimated:
            filter_.consolidate()
            joint = filter_.marginals.parts[Part.LANDMARK]
            assert isinstance(joint, JointMap)
            joint.presume(Constants(np.zeros(self.learnt.size), self._cov))
        return self.is_estimated

    def wheels(self, filter_: Filter) -> tuple[np.ndarray, np.ndarray]:
        """What the wheels get wrong as far as it is found (4,), as in `wheel_errors`, and its standard deviations (4,)."""
        found, std, own = np.zeros(4), np.zeros(4), self.learnt >= self.space.dim
        if own.any() and self.is_estimated:
            (mean, cov), at = filter_.belief().moments(Part.SUBSTATE), self.learnt[own] - self.space.dim
            found[at], std[at] = mean[own], np.sqrt(np.diagonal(cov))[own]
        return found, std

    def corrected(self, filter_: Filter, deltas: np.ndarray) -> np.ndarray:
        """Odometry (T, E) without what is found to be wrong with it."""
        wrong = self.wheels(filter_)[0]
        return self.space.compose(deltas, self.space.exp(wheel_errors(deltas) @ wrong)) if wrong.any() else deltas

    def sensor_pose(self, filter_: Filter) -> tuple[np.ndarray, np.ndarray]:
        """Robot_from_sensor (E,) as it is given or found, and its covariance (d, d) in the right chart."""
        if not self.free.any():
            return self.model.robot_from_sensor, np.zeros((self.space.dim, self.space.dim))
        mean, cov = filter_.belief().moments(Part.SUBSTATE)
        slope = self.space.right_jacobian(self.free @ mean) @ self.free
        return self.model.tuned(mean, self.free).robot_from_sensor, slope @ cov @ slope.T

    def entries(self, filter_: Filter) -> dict[str, Any]:
        """For summary.json: what was found, with standard deviations; nothing where nothing is estimated."""
        if not self.is_estimated:
            return {}
        found = dict[str, tuple[float, float]]()
        if self.free.any():
            (mean, cov), space = self.sensor_pose(filter_), self.space
            place, turn, dim = space.translation(mean), space.rotation(mean), len(self.space.translation(mean))
            within = np.sqrt(np.diagonal(turn @ cov[-dim:, -dim:] @ turn.T))
            found |= dict(zip(["x_m", "y_m", "z_m"], zip(place, within, strict=True), strict=False))
            if self.free[-dim - 1].any():
                yaw, std = np.arctan2(turn[1, 0], turn[0, 0]), np.sqrt(cov[-dim - 1, -dim - 1])
                found["yaw_deg"] = np.rad2deg(yaw), np.rad2deg(std)
        wheels, names = np.array(self.wheels(filter_)).T, ("heading_deg_per_m", "turn_left", "turn_right", "distance")
        for row in self.learnt[self.learnt >= self.space.dim] - self.space.dim:
            found[names[row]] = tuple(np.rad2deg(wheels[0]) if row == 0 else wheels[row])
        stds = {f"std_{name}": float(std) for name, (_, std) in found.items()}
        return {"calibration": {name: float(value) for name, (value, _) in found.items()} | stds}
