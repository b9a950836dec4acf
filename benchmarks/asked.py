"""Required limit and goal of each benchmark's figure, or of its ratio to the floor."""

from dataclasses import dataclass

from benchmarks.rows import Row


@dataclass(frozen=True)
class Limit:
    """Limits of a row: `asked` is required, `goal` desired; lower (`least`) or upper limits of the ratio or the figure."""

    asked: float
    goal: float | None = None
    least: bool = False
    ratio: bool = False

    def words(self, limit: float | None, row: Row) -> str:
        """One of the limits, with its unit."""
        if limit is None:
            return ""
        return f"{'>=' if self.least else '<='} {limit:g} {'×' if self.ratio else row.unit.split(',')[0]}"

    def met(self, limit: float, row: Row) -> bool:
        """Whether the row meets one of the limits."""
        value = row.ratio if self.ratio else row.figure
        return value >= limit if self.least else value <= limit


LIMITS = {
    "rbpf --help": Limit(0.3),
    "rbpf run mono, before the first frame": Limit(1.0),
    "first compilation": Limit(45.0, 20.0),
    "update 50x30x300 vs loop": Limit(20.0, least=True, ratio=True),
    "update 50x30x300 vs twin": Limit(0.3, 0.2),
    "update, 100000 landmarks": Limit(1.05, ratio=True),
    "resampling, 100000 landmarks": Limit(1.05, ratio=True),
    "joining a sub-map, far along": Limit(1.1, ratio=True),
    "refine 50000x30 planar": Limit(30.0, 60.0, least=True),
    "update 50000x30 planar": Limit(30.0, 60.0, least=True),
    "refine 50000x30 spatial": Limit(30.0, 60.0, least=True),
    "update 50000x30 spatial": Limit(15.0, 60.0, least=True),
    "map storage 400x11085": Limit(0.1, ratio=True),
    "history kept, N=100000": Limit(3.0, ratio=True),
    "genealogy nodes, always": Limit(1.25, ratio=True),
    "genealogy nodes, ESS < N/2": Limit(1.25, ratio=True),
    "user's NumPy model 50x30": Limit(6.0, 4.0, ratio=True),
    "user's NumPy model 1000x30": Limit(6.0, 4.0, ratio=True),
    "mono step, 50 particles, 25 measurements": Limit(0.6, 0.4),
    "mono frames 320x240": Limit(250.0, 400.0, least=True),
    "mono frames 640x480": Limit(180.0, 250.0, least=True),
    "mono frame, 10000 landmarks": Limit(1.05, ratio=True),
    "patch search, 25 ellipses of 10 px": Limit(1.2, least=True, ratio=True),
    "patch search, 320x240": Limit(1.2, least=True, ratio=True),
    "40 corners of 640x480": Limit(1.0, least=True, ratio=True),
    "descriptors of a map of 40000, gated": Limit(10.0),
    "motion of two stereo frames, 300 matches": Limit(0.8, least=True, ratio=True),
    "stereo update, 400 particles, 11000 landmarks": Limit(30.0),
    "stereo pair 640x480, 400 particles": Limit(35.0, 25.0),
    "stereo memory, 400 particles, 11000 landmarks each": Limit(0.7 * 1024),
    **{f"bootstrap N={n} vs particles": Limit(1.0, 2.0, least=True, ratio=True) for n in (100, 1_000, 10_000, 100_000)},
}
"""Limits by the row's name; other rows have none."""


def verdict(row: Row) -> tuple[str, str, str]:
    """Required limit, goal, and whether they are met."""
    limit = LIMITS.get(row.name)
    if limit is None:
        return "", "", ""
    reached = limit.goal is not None and limit.met(limit.goal, row)
    met = "goal" if reached else "met" if limit.met(limit.asked, row) else "MISSED"
    return limit.words(limit.asked, row), limit.words(limit.goal, row), met
