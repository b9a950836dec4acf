"""Figure 3: time per frame by the number of landmarks in the map."""

import time
from typing import Any

import numpy as np

from examples.studies.e06.setting import Row, Setting
from examples.studies.e06.worlds import flat_desk
from rbpf.core.models import Records
from rbpf.lie import SE3
from rbpf.maps.point import Point
from rbpf.runs.plots import label, save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.systems.mono.feature_table import PATCH_PX
from rbpf.systems.system import Tracked

SIZES = 100, 300, 1000, 3000, 10_000
AWAY_M = 2.0, 20.0
ASIDE = float(np.cos(np.deg2rad(75.0)))
"""Least distance of added landmarks from the optical axis, so that they do not come into view."""

WARM_UP, FRAMES, SETTLE = 20, 20, 3
"""Number of frames before the first measurement, frames per size, and uncounted ones of these."""
STD_M = 0.01
FLAT = 1.25
"""Largest growth of the time from the smallest to the largest map for which it counts as constant."""


class _Watch:
    """Records the times of each frame, and fills the map up to the next size every `FRAMES` frames.

    The whole frame is measured in processor time, including decoding, so that other load on the machine does not affect
    the comparison of sizes.
    """

    def __init__(self, sizes: tuple[int, ...], rng: np.random.Generator) -> None:
        self.sizes, self.rng = sizes, rng
        self.seconds: dict[int, list[list[float]]] = {size: [] for size in sizes}
        self._last = time.process_time()

    def __call__(self, run: Run, _: Tracked) -> None:
        """Called after a frame."""
        t = len(run.log) - 1
        whole = time.process_time() - self._last
        turn, since = divmod(t - WARM_UP, FRAMES)
        if 0 <= turn < len(self.sizes) and since >= SETTLE:
            measurement = run.system.measurement
            assert measurement is not None
            search, step = float(run.log["seconds_search"][t]), float(run.log["seconds"][t])
            self.seconds[self.sizes[turn]].append([whole, step - search, search, measurement.search.seconds_choosing])
        if since == FRAMES - 1 and turn + 1 < len(self.sizes):
            fill(run, self.sizes[turn + 1], self.rng)
        self._last = time.process_time()


def fill(run: Run, size: int, rng: np.random.Generator) -> None:
    """Adds points around but out of view, equal in all particles, until the map has `size` landmarks."""
    belief, table = run.system.filter.belief(), run.system.sensor.table
    count = size - belief.map.ids.size
    if count <= 0:
        return
    pose = belief.state[belief.mode][:7]
    source = rng.integers(0, 256, (count, PATCH_PX, PATCH_PX)).astype(np.uint8)
    rows = table.add(source, np.zeros((count, 2)), pose)
    along, turn = rng.uniform(-1.0, ASIDE, count), rng.uniform(0.0, 2.0 * np.pi, count)
    side = np.sqrt(1.0 - along**2)
    direction = np.stack([side * np.cos(turn), side * np.sin(turn), along], axis=-1)
    points = SE3.transform(pose, rng.uniform(*AWAY_M, (count, 1)) * direction)
    table.position[rows] = np.concatenate([points, np.ones((count, 1))], axis=1)
    n = run.system.filter.n
    records = Records(np.broadcast_to(points, (n, count, 3)), np.broadcast_to(STD_M**2 * np.eye(3), (n, count, 3, 3)))
    belief.map.add_records(records, Point(3), ids=rows)


def measure_times(setting: Setting, sizes: tuple[int, ...], rounds: int) -> np.ndarray:
    """Median times (S, 4) of a frame by size of the map [s].

    The columns: processor time of the whole frame, including decoding; then wall-clock times of the filter, of the search,
    and of the selection of features, which is part of the search.
    """
    frames = WARM_UP + FRAMES * len(sizes)
    sequence, known = setting.sequence("times", flat_desk(frames, 0.002))
    found: dict[int, list[list[float]]] = {size: [] for size in sizes}
    for turn in range(rounds):
        watch = _Watch(sizes, np.random.default_rng(turn))
        filter_opened(open_mono(sequence, setting.config(), known), [watch])
        for size, seconds in watch.seconds.items():
            found[size] += seconds
    return np.array([np.median(found[size], axis=0) for size in sizes])


def reproduce(setting: Setting) -> list[Row]:
    """Measures and draws."""
    sizes = (100, 2000) if setting.quick else SIZES
    times = 1e3 * measure_times(setting, sizes, 1 if setting.quick else 3)
    save_figures({"figure_3.png": _draw(np.array(sizes), times)}, setting.out)
    growth = float(times[-1, 0] / times[0, 0])
    rate, choice = f"{times[0, 0]:.1f} ms at {sizes[0]}", f"{times[-1, 3]:.2f} ms of it"
    return [
        Row(
            "Fig. 3",
            f"processor time per frame, {sizes[0]} to {sizes[-1]} landmarks",
            "independent of the map",
            f"x {growth:.2f} ({rate})",
            growth,
            growth <= FLAT,
        ),
        Row(
            "Fig. 3",
            f"choice of what to look for at {sizes[-1]}",
            "very small, O(N)",
            choice,
            float(times[-1, 3] / times[-1, 0]),
        ),
    ]


def _draw(sizes: np.ndarray, times: np.ndarray) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    label(axes, "time per frame (Fig. 3)", "landmarks in the map", "ms, median", equal=False)
    for column, name in enumerate(("whole frame, processor time", "filter", "search", "choice of what to look for")):
        axes.plot(sizes, times[:, column], "o-", label=name)
    axes.axhline(1e3 / 30.0, color="0.5", ls="--", lw=0.8, label="30 Hz")
    axes.set(xscale="log", ylim=(0.0, None))
    axes.legend(fontsize="small")
    return figure
