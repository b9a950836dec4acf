"""A jump Markov system: modes are sampled, the linear state given the modes is marginalised; with the exact posterior.

A tank's level rises while its valve is closed and falls while it is open; the valve is not observed, and measurements
of the level are noisy. Given the valve's history the level is Gaussian, a Kalman filter in each particle; the exact
posterior sums over all histories.
"""

import numpy as np

from rbpf import Filter, Finite, KalmanSubstate, MotionModel, ObservationModel, Observations, Part, Sensor, Transition

STAYS = np.array([0.9, 0.8])  # probability that the valve stays closed, open
RISE, STD_RISE = np.array([0.5, -1.5]), np.array([0.1, 0.3])  # per step
STD_LEVEL, STD_START = 1.0, 2.0
STEPS, PARTICLES = 14, 200


class Tank(MotionModel):
    """Valve in {0, 1}; the level is the substate, s' = s + rise(valve) + noise(valve)."""

    space = Finite(2)

    def sample(self, state, control, dt, rng):
        stays = np.where(dt > 0, STAYS[state.astype(int)], 1.0)  # no time passes before the first step
        return np.where(rng.random(state.shape) < stays, state, 1.0 - state)

    def transition(self, state, control, dt):
        valve, n = state[:, 0].astype(int), len(state)
        noise, rise = STD_RISE[valve] * dt, RISE[valve] * dt
        return Transition(state, noise.reshape(n, 1, 1), np.zeros((1, 0, 1)), np.ones((1, 1, 1)), rise.reshape(n, 1))


class Level(ObservationModel):
    dim, reads = 1, frozenset({Part.SUBSTATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return substate


class Gauge(Sensor):
    """A frame is one measured level."""

    def observe(self, frame, belief):
        return [Observations(np.array([[frame]]), np.array([[[STD_LEVEL**2]]]), Level())]


def enumerated(levels: np.ndarray) -> tuple[np.ndarray, float]:
    """P(valve open) after each step (T,), and the log-evidence, by a Kalman filter along each of 2^T histories."""
    valve, mean, var, log_p = np.arange(2), np.zeros(2), np.full(2, STD_START**2), np.log([0.5, 0.5])
    is_open, first = [], True
    for z in levels:
        if not first:
            # Every history branches into two.
            before, valve = np.repeat(valve, 2), np.tile([0, 1], valve.size)
            chance = np.where(valve == before, STAYS[before], 1 - STAYS[before])
            log_p = np.repeat(log_p, 2) + np.log(chance)
            mean, var = np.repeat(mean, 2) + RISE[valve], np.repeat(var, 2) + STD_RISE[valve] ** 2
        first, gain = False, var / (var + STD_LEVEL**2)
        log_p = log_p - 0.5 * ((z - mean) ** 2 / (var + STD_LEVEL**2) + np.log(2 * np.pi * (var + STD_LEVEL**2)))
        mean, var = mean + gain * (z - mean), (1 - gain) * var
        p = np.exp(log_p - log_p.max())
        is_open.append(p @ valve / p.sum())
    return np.array(is_open), float(np.logaddexp.reduce(log_p))


def main() -> dict[str, float]:
    """Prints the probability that the valve is open, and the exact one."""
    rng, valve, level, levels = np.random.default_rng(5), 0, 0.0, []
    for t in range(STEPS):
        if t:
            valve = valve if rng.random() < STAYS[valve] else 1 - valve
            level += RISE[valve] + STD_RISE[valve] * rng.standard_normal()
        levels.append(level + STD_LEVEL * rng.standard_normal())
    rng = np.random.default_rng(0)
    start, held = rng.integers(0, 2, (PARTICLES, 1)), KalmanSubstate(Finite(2), np.zeros(1), STD_START**2 * np.eye(1))
    filter_, ours = Filter(Tank(), Gauge(), held, n=PARTICLES, rng=rng, start=start), []
    for z in levels:
        filter_.step(z)
        ours.append(Finite(2).probabilities(filter_.particles.state, filter_.particles.weights)[1])
    exact, log_evidence = enumerated(np.array(levels))
    for t in range(STEPS):
        print(f"step {t:2d}: open with probability {ours[t]:.2f}, exact {exact[t]:.2f}")
    print(f"log-evidence {filter_.log_evidence:.2f}, exact {log_evidence:.2f}")
    return {"off": float(np.abs(ours - exact).max()), "evidence": filter_.log_evidence - log_evidence}


if __name__ == "__main__":
    main()
