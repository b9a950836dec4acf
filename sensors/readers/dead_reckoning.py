"""Motion and its covariance from readings of speed and turn rate.

A reading holds until the next one, so that the motion over a piece of length dt is exactly
Exp(dt [turn rate, speed, 0]). Both carry white noise, whose standard deviations are therefore densities, per
root second: over a time T the heading drifts by std_turn_rate * sqrt(T), and the noise of a piece is independent
of that of the others,

    delta = prod_k Exp(dt_k [omega_k, v_k, 0] + sqrt(dt_k) [e_omega, e_v, 0]),
    e_omega ~ N(0, std_turn_rate^2),  e_v ~ N(0, std_speed^2).

Its covariance is sum_k G_k diag(std_turn_rate^2, std_speed^2) G_k^T dt_k with G_k the derivative in the right
chart. No piece slips sideways, so that the covariance of a single piece is singular.
"""

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import SE2, Array


def integrate(
    readings_ns: NDArray[np.int64], turn_rate: Array, speed: Array, instants_ns: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Motion between consecutive instants.

    Args:
        readings_ns: (n,) times of the readings, in order; the robot stands still before the first.
        turn_rate: (n,) [rad/s].
        speed: (n,) forward [m/s].
        instants_ns: (T,) times in strict order.

    Returns:
        delta (T - 1, 3), elements of SE(2), and their covariance (T - 1, 2, 3, 3) by unit noise of the turn rate
        and by unit noise of the speed, in the right chart at delta.
    """
    if len(instants_ns) == 1:
        return np.empty((0, 3)), np.empty((0, 2, 3, 3))
    within = readings_ns[(readings_ns > instants_ns[0]) & (readings_ns < instants_ns[-1])]
    edges = np.union1d(instants_ns, within)
    dt = np.diff(edges) / 1e9
    reading = np.searchsorted(readings_ns, edges[:-1], side="right") - 1
    moving = np.where(reading >= 0, dt, 0.0)
    xi = np.stack([moving * turn_rate[reading], moving * speed[reading], np.zeros_like(dt)], axis=1)
    bounds = np.searchsorted(edges, instants_ns)
    start, end = bounds[:-1], bounds[1:]
    chain = _chain(xi)
    delta = SE2.between(chain[start], chain[end])
    # The noise of a piece of a piece is carried through the rest of its interval.
    end_from_piece = SE2.between(chain[np.repeat(end, end - start)], chain[1:])
    gain = np.moveaxis(SE2.adjoint(end_from_piece) @ SE2.right_jacobian(xi)[:, :, :2], 2, 1)
    gain *= np.sqrt(dt)[:, None, None]
    return delta, np.add.reduceat(gain[..., :, None] * gain[..., None, :], start, axis=0)


def _chain(xi: Array) -> Array:
    # The product of all motions before each piece, and of all: headings add up, then translations do.
    motion = SE2.exp(xi)
    chain = np.zeros((len(xi) + 1, 3))
    chain[1:, 0] = np.cumsum(xi[:, 0])
    chain[1:, 1:] = np.cumsum(SE2.transform(chain[:-1] * [1, 0, 0], motion[:, 1:]), axis=0)
    return chain
