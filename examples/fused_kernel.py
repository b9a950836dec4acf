"""Speed for a custom model: a compiled kernel beside the NumPy methods.

The kernel computes innovation and Jacobians of one measurement for a block of particles. Nothing else changes:
the same filter uses it, `check_model` compares it with the NumPy methods, and both give the same
estimate.
"""

import math
import time

import numpy as np
from custom_sensor import LampSensor, simulate
from numba import njit

from rbpf import SE2, Filter, LandmarkMap, Point, check_model
from rbpf.core.models import FusedKernel
from rbpf.kernels.signature import observation_kernel
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor


@njit(cache=True)
def _store(row, d0, d1, x, y, c, s, jac_state, jac_landmark, i):
    """Stores a row (d0, d1), ∂z/∂point in the robot's frame, as ∂z/∂tangent and ∂z/∂landmark."""
    jac_state[row, 0, i] = d0 * y - d1 * x
    jac_state[row, 1, i] = -d0
    jac_state[row, 2, i] = -d1
    jac_landmark[row, 0, i] = d0 * c - d1 * s
    jac_landmark[row, 1, i] = d0 * s + d1 * c


@observation_kernel
def lamp_kernel(state, mean, const, z, params, n, nu, jac_state, jac_landmark):
    cos_z, sin_z = math.cos(z[0]), math.sin(z[0])
    for i in range(n):
        c, s = math.cos(state[0, i]), math.sin(state[0, i])
        dx, dy = mean[0, i] - state[1, i], mean[1, i] - state[2, i]
        x, y = c * dx + s * dy, c * dy - s * dx
        square = x * x + y * y
        nu[0, i] = math.atan2(sin_z * x - cos_z * y, cos_z * x + sin_z * y)
        nu[1, i] = z[1] + math.log(square)
        _store(0, -y / square, x / square, x, y, c, s, jac_state, jac_landmark, i)
        _store(1, -2.0 * x / square, -2.0 * y / square, x, y, c, s, jac_state, jac_landmark, i)


class FastLampSensor(LampSensor):
    """The lamp sensor with its compiled twin."""

    def kernel(self):
        return FusedKernel(lamp_kernel, np.zeros(0))


def filtered(model: LampSensor, particles: int) -> tuple[np.ndarray, float]:
    """Final estimate (3,), and milliseconds per step."""
    frames, _, _ = simulate(np.random.default_rng(3), steps=60)
    sensor = NamedLandmarkSensor(model, Point(2))
    filter_ = Filter(OdometryMotion(SE2), sensor, LandmarkMap(SE2), n=particles, rng=np.random.default_rng(0))
    started = time.perf_counter()
    for frame in frames:
        estimate = filter_.step(frame, frame.control).estimate
    return estimate.mean, 1e3 * (time.perf_counter() - started) / len(frames)


def main() -> dict[str, float]:
    """Prints the result of check_model, the difference of the estimates, and the times per step."""
    findings = check_model(FastLampSensor(), SE2)
    print("check_model:", "; ".join(findings) or "kernel and NumPy methods agree")
    plain, slow = filtered(LampSensor(), particles=1000)
    compiled, fast = filtered(FastLampSensor(), particles=1000)
    difference = float(np.abs(plain - compiled).max())
    print(f"1000 particles: {slow:.1f} ms per step in NumPy, {fast:.1f} ms with the kernel")
    print(f"largest difference of the last estimate: {difference:.1e}")
    return {"findings": len(findings), "difference": difference, "speedup": slow / fast}


if __name__ == "__main__":
    main()
