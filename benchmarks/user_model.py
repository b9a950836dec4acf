"""Cost of a user's `predict` and `residual` in plain NumPy, with numeric Jacobians, compared with a kernel."""

import numpy as np

from benchmarks.rows import Row, Settings, interleaved
from benchmarks.worlds import Run, planar
from rbpf.core.models import ObservationModel

K, M = 30, 300
CALLS = {"kernel": 5}


class UserRangeBearing(ObservationModel):
    """(range, bearing) of a landmark, as a user writes it in a few lines."""

    dim = 2

    def predict(
        self,
        state: np.ndarray,
        landmark: np.ndarray | None = None,
        const: np.ndarray | None = None,
        substate: np.ndarray | None = None,
    ) -> np.ndarray:
        assert landmark is not None
        dx, dy = landmark[..., 0] - state[..., 1], landmark[..., 1] - state[..., 2]
        return np.stack([np.hypot(dx, dy), np.arctan2(dy, dx) - state[..., 0]], axis=-1)

    def residual(self, z: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        difference = z - predicted
        difference[..., 1] = (difference[..., 1] + np.pi) % (2 * np.pi) - np.pi
        return difference


def run(settings: Settings) -> list[Row]:
    """Few particles, dominated by calls, and many, dominated by arithmetic."""
    return [figure(50, settings.repetitions(90)), figure(1000, settings.repetitions(30))]


def figure(n: int, turns: int) -> Row:
    warm_up = 3
    ours = Run(planar(K, M), n, CALLS["kernel"] * (turns + warm_up))
    user = Run(planar(K, M), n, turns + warm_up, model=UserRangeBearing())
    times = interleaved({"kernel": ours.step, "user": user.step}, turns, CALLS, warm_up)
    slow, fast = times["user"].median, times["kernel"].median
    return Row(
        f"user's NumPy model {n}x30",
        slow * 1e3,
        "ms",
        "built-in kernel",
        fast * 1e3,
        slow / fast,
        higher=False,
        notes=f"{times['user'].spread}; {user.diversity.text()}",
    )
