"""Random trajectories."""

from collections.abc import Callable

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.runs.trajectory import Trajectory


@pytest.fixture
def wander() -> Callable[[int, int], Trajectory]:
    """A trajectory of (length, seed) far from the origin, with steps of about 0.3 m and 10 degrees."""

    def make(length: int, seed: int) -> Trajectory:
        rng = np.random.default_rng(seed)
        poses = [SE3.retract(SE3.identity(), rng.normal(scale=[1.0, 1.0, 1.0, 50.0, 50.0, 50.0]))]
        for step in rng.normal(scale=[0.1, 0.1, 0.1, 0.3, 0.1, 0.1], size=(length - 1, 6)):
            poses.append(SE3.retract(poses[-1], step))
        return Trajectory(1_400_000_000_000_000_000 + 100_000_000 * np.arange(length), np.array(poses))

    return make
