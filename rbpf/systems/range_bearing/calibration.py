"""Self-calibration of a robot: its sensor's mounting pose and systematic odometry errors, as constants of the joint map."""

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
"""Score test threshold in standard deviations, at which a systematic odometry error counts as detected."""
AS_GOOD_AS_KNOWN = 1e-4
"""Standard deviation of the constants before detection, as a fraction of that after it."""
_SCORE = numbers(3, "learnt", values="any")  # sums of squares may be larger than other numbers that are kept


@final
class RobotCalibration(Kept):
    """Constants (m,) of a joint map: the uncertain ones of the sensor's mounting coordinates and `wheel_errors`.

    By default (`calibrate=auto`) they are nearly fixed until a score test, Mathematics (wheel-score), detects an error.
    `is_possible` tells whether the map is joint with known association. Raises InputError: an explicitly requested
    calibration is not possible, or has nothing to estimate.
    """

    kept: ClassVar = {"score": _SCORE, "_before": numbers("dim", "learnt"), "is_estimated": truths()}
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
        self.learnt = np.flatnonzero(std)  #: (m,) indices of the uncertain ones among all (d + 4,).
        self.free = np.eye(space.dim, std.size)[:, self.learnt]  #: (d, m) derivative of the mounting pose by them.
        self.is_estimated = is_asked
        #: Sum of the score, its variance without systematic errors, and sum of squares.
        self.score = np.zeros((3, self.learnt.size))
        self._before = np.zeros((space.dim, self.learnt.size))  # derivative of the last step's odometry by them
        self._cov = np.diag(std[self.learnt] ** 2)
        scale = 1.0 if is_asked else AS_GOOD_AS_KNOWN
        self.prior = np.zeros(self.learnt.size), scale**2 * self._cov

    def driven(self, odometry: Odometry | None) -> Odometry | None:
        """The odometry with its derivative by them."""
        wheels = self.learnt >= self.space.dim
        if odometry is None or not wheels.any():
            return odometry
        by_constants = np.zeros((self.space.dim, self.learnt.size))
        by_constants[:, wheels] = wheel_errors(odometry.delta)[:, self.learnt[wheels] - self.space.dim]
        return replace(odometry, by_constants=by_constants)

    def tuned(self, filter_: Filter) -> RigidPointModel:
        """The sensor model at the particles' mean mounting pose."""
        if not self.free.any():
            return self.model
        own = filter_.marginals.driving()
        assert own is not None
        return self.model.tuned(filter_.particles.weights @ own, self.free)

    def watch(self, filter_: Filter, odometry: Odometry, factor: np.ndarray, found: Correction | None) -> bool:
        """Score test of an odometry step, by the posterior of its noise, whose covariance has the factor (d, r).

        Returns whether the estimation of systematic odometry errors starts with this step.
        """
        if self.is_estimated or odometry.by_constants is None or found is None:
            return False
        # With the previous step's derivative: the current odometry is correlated with its own noise, which is tested.
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
        """The estimated systematic errors (4,), as of `wheel_errors`, and their standard deviations (4,)."""
        found, std, own = np.zeros(4), np.zeros(4), self.learnt >= self.space.dim
        if own.any() and self.is_estimated:
            (mean, cov), at = filter_.belief().moments(Part.SUBSTATE), self.learnt[own] - self.space.dim
            found[at], std[at] = mean[own], np.sqrt(np.diagonal(cov))[own]
        return found, std

    def corrected(self, filter_: Filter, deltas: np.ndarray) -> np.ndarray:
        """Odometry (T, E) without the estimated systematic errors."""
        wrong = self.wheels(filter_)[0]
        return self.space.compose(deltas, self.space.exp(wheel_errors(deltas) @ wrong)) if wrong.any() else deltas

    def sensor_pose(self, filter_: Filter) -> tuple[np.ndarray, np.ndarray]:
        """Robot_from_sensor (E,) as given or estimated, and its covariance (d, d) in the right chart."""
        if not self.free.any():
            return self.model.robot_from_sensor, np.zeros((self.space.dim, self.space.dim))
        mean, cov = filter_.belief().moments(Part.SUBSTATE)
        slope = self.space.right_jacobian(self.free @ mean) @ self.free
        return self.model.tuned(mean, self.free).robot_from_sensor, slope @ cov @ slope.T

    def entries(self, filter_: Filter) -> dict[str, Any]:
        """Entries of summary.json: estimates with standard deviations; empty without any."""
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
