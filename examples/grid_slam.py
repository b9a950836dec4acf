"""Grid SLAM with a custom conditional part, an occupancy grid in every particle, compared with the exact posterior.

A robot moves round a ring of cells, some of which have a door. Steps may fail, and the sensor has errors. Given the path,
the cells are independent probabilities, as in the first Rao-Blackwellised SLAM (K. Murphy 1999). The exact posterior sums
over all maps and all positions. A laser scanner's grid in the plane is such a part, too: `rbpf.maps.grid.GridMap`.
"""

import numpy as np

from rbpf import Conditional, Filter, Finite, LogDensities, MotionModel, Observations, Part, Sensor
from rbpf.gaussian import mixture_moments

DOORS = Part("doors")
CELLS, STEPS, PARTICLES = 8, 40, 1000
ADVANCES, RIGHT = 0.8, 0.9  # probability that a step succeeds, that the sensor is right


class Robot(MotionModel):
    """The state is the robot's cell; a step leads to the next one, or fails."""

    space = Finite(CELLS)

    def sample(self, state, control, dt, rng):
        return (state + (rng.random(state.shape) < ADVANCES * (dt > 0))) % CELLS


class Grid(Conditional):
    """Log-odds (N, CELLS) of a door."""

    supplies, takes_raw = DOORS, True

    def begin(self, n, lineage):
        self.log_odds = np.zeros((n, CELLS))

    def correct(self, state, increment, groups):
        here, total = (np.arange(len(state)), state[:, 0].astype(int)), np.zeros(len(state))
        for group in groups:
            door = 1.0 / (1.0 + np.exp(-self.log_odds[here]))
            sign = 1.0 if group.data else -1.0
            total += np.log(0.5 + sign * (door - 0.5) * (2.0 * RIGHT - 1.0))
            self.log_odds[here] += sign * np.log(RIGHT / (1.0 - RIGHT))
        return LogDensities(all=total, after_sampling=total)

    def resample(self, ancestors):
        self.log_odds = self.log_odds[ancestors]

    def moments(self, particles, of):
        door = 1.0 / (1.0 + np.exp(-self.log_odds))
        return mixture_moments(particles.weights, door, (door * (1.0 - door))[:, :, None] * np.eye(CELLS))

    def arrays(self):
        return {"log_odds": self.log_odds}

    def restore(self, arrays):
        self.log_odds = arrays["log_odds"]


class DoorSensor(Sensor):
    """A frame is True or False: a door at the robot's cell, or none."""

    def observe(self, frame, belief):
        return [Observations.raw(frame, DOORS)]


def simulate(rng: np.random.Generator) -> tuple[np.ndarray, list[bool], int]:
    """The map (CELLS,), the observation of each step, and the robot's final cell."""
    doors, cell, seen = np.array([1, 0, 0, 1, 0, 1, 1, 0]), 0, []
    for t in range(STEPS):
        cell = (cell + int(t > 0 and rng.random() < ADVANCES)) % CELLS
        seen.append(bool(doors[cell]) == (rng.random() < RIGHT))
    return doors, seen, cell


def summed(seen: list[bool]) -> tuple[np.ndarray, np.ndarray, float]:
    """P(door) (CELLS,), P(cell) (CELLS,) and the log-evidence, over all maps and all cells (forward algorithm)."""
    maps = (np.arange(2**CELLS)[:, None] >> np.arange(CELLS)) & 1
    p, log_evidence = np.zeros(maps.shape), 0.0
    p[:, 0] = 1.0 / len(maps)
    for t, door in enumerate(seen):
        if t:
            p = ADVANCES * np.roll(p, 1, axis=1) + (1.0 - ADVANCES) * p
        p = p * np.where(maps == door, RIGHT, 1.0 - RIGHT)
        log_evidence += np.log(p.sum())
        p = p / p.sum()
    return p.sum(axis=1) @ maps, p.sum(axis=0), float(log_evidence)


def main() -> dict[str, float]:
    """Prints the probability of a door in each cell, and the exact one."""
    doors, seen, cell = simulate(np.random.default_rng(2))
    filter_ = Filter(Robot(), DoorSensor(), Grid(), n=PARTICLES, rng=np.random.default_rng(0))
    for frame in seen:
        filter_.step(frame)
    found, cov = filter_.belief().moments(DOORS)
    place = Finite(CELLS).probabilities(filter_.particles.state, filter_.particles.weights)
    exact, exact_place, log_evidence = summed(seen)
    for k in range(CELLS):
        print(
            f"cell {k}: {'door' if doors[k] else 'wall'}, {found[k]:.2f} ± {cov[k, k] ** 0.5:.2f}, exact {exact[k]:.2f}"
        )
    print(f"the robot is in cell {cell}: {place[cell]:.2f}, exact {exact_place[cell]:.2f}")
    print(f"log-evidence {filter_.log_evidence:.2f}, exact {log_evidence:.2f}")
    off = float(np.abs(found - exact).max())
    return {
        "off": off,
        "place": float(np.abs(place - exact_place).max()),
        "evidence": filter_.log_evidence - log_evidence,
    }


if __name__ == "__main__":
    main()
