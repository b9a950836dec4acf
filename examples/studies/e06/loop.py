"""Figure 5: loop closure, with re-observation of the first landmarks."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from examples.studies.e06.new_landmarks import round_a_desk
from examples.studies.e06.setting import Row, Setting, true_poses
from rbpf.lie import SE3
from rbpf.runs.plots import COLOURS, SIGMAS, label, outline, save_figures
from rbpf.runs.run import Run
from rbpf.systems.map_estimate import MapEstimate

START = 15
"""Number of first frames whose new landmarks are the landmarks of the start."""

AWAY = 30
"""Least number of frames without any of them for an absence."""


@dataclass(frozen=True)
class Closure:
    """Re-observation of the landmarks of the start.

    Attributes:
        first: number of landmarks of the start.
        again: number of them found after the longest absence.
        left: last frame in which one was found before it.
        back: first frame in which one was found after it; −1 for none.
    """

    first: int
    again: int
    left: int
    back: int


def find_closure(frames: list[dict[str, np.ndarray]], first: int) -> Closure:
    """Computes the closure from a run's observations, frame by frame, for features with rows below `first`.

    The absence is the longest run of frames in which none of them was found.
    """
    seen = []
    for frame in frames:
        features = frame["features"]
        found = np.isfinite(frame["px"]).all(axis=1)
        seen.append(np.unique(features[found & (features < first)]))
    seen[0] = np.arange(first)
    times = np.flatnonzero([rows.size > 0 for rows in seen])
    gaps = np.diff(times)
    if not gaps.size or gaps.max() < AWAY:
        return Closure(first, 0, int(times[-1]), -1)
    longest = int(gaps.argmax())
    left, back = int(times[longest]), int(times[longest + 1])
    again = np.unique(np.concatenate(seen[back:]))
    return Closure(first, again.size, left, back)


def started_until(frames: list[dict[str, np.ndarray]], until: int) -> int:
    """Number of features initialised in the first frames, including known points."""
    return sum(frame["started"].size for frame in frames[:until])


def reproduce(setting: Setting) -> list[Row]:
    """Filters the loop."""
    sequence, run, _ = round_a_desk(setting)
    mapped = run.system.map()
    first = started_until([*map(run.log.observed, range(len(run.log)))], START)
    closure = find_closure([*map(run.log.observed, range(len(run.log)))], first)
    truth = true_poses(sequence)[: run.log.stamps_ns.size]
    error = np.linalg.norm(SE3.translation(run.log.poses) - SE3.translation(truth), axis=1)
    save_figures({"figure_5.png": _draw(run, mapped, truth, error, closure)}, setting.out)
    return _rows(closure, error, truth, int((~mapped.is_ray()).sum()))


def _rows(closure: Closure, error: np.ndarray, truth: np.ndarray, full: int) -> list[Row]:
    fraction = closure.again / closure.first
    closed = closure.back >= 0
    before = float(error[closure.back - 1]) if closed else float("nan")
    after = float(np.median(error[-10:])) if closed else float("nan")
    way = float(np.linalg.norm(np.diff(SE3.translation(truth), axis=0), axis=1).sum())
    away = closure.back - closure.left - 1 if closed else 0
    return [
        Row("Fig. 5", "landmarks in the map (points)", "98", f"{full}", float(full)),
        Row(
            "Fig. 5",
            f"landmarks of the start found again after {away} frames out of sight",
            "re-acquired",
            f"{closure.again} of {closure.first}",
            fraction,
            fraction >= 0.5,
        ),
        Row(
            "Fig. 5",
            f"error of the position after {way:.1f} m, before and after they are found",
            "",
            f"{1e3 * before:.1f} and {1e3 * after:.1f} mm",
            after,
        ),
    ]


def _draw(run: Run, mapped: MapEstimate, truth: np.ndarray, error: np.ndarray, closure: Closure) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 5.5), layout="constrained")
    above, curve = figure.subplots(1, 2)
    label(above, "map from above, the loop closed (Fig. 5)", "x [m]", "y [m]", equal=True)
    full = ~mapped.is_ray()
    mean, cov = mapped.mean[full], mapped.cov[full]
    for ellipse in outline(mean[:, :2], cov[:, :2, :2]):
        above.plot(*ellipse.T, color=COLOURS["map"], lw=0.6)
    above.plot(*mean[:, :2].T, ".", color="black", ms=3, label=f"landmarks, {SIGMAS:g}σ")
    above.plot(*SE3.translation(truth)[:, :2].T, color=COLOURS["truth"], lw=1.0, ls="--", label="true path")
    above.plot(*SE3.translation(run.log.poses)[:, :2].T, color=COLOURS["filter"], lw=1.2, label="filter")
    if run.system.known is not None:
        above.plot(*run.system.known.positions[:, :2].T, "+", color=COLOURS["known"], ms=9, label="known points")
    above.legend(fontsize="small")
    label(curve, "error of the position", "frame", "mm", equal=False)
    curve.plot(1e3 * error, color=COLOURS["filter"])
    if closure.back >= 0:
        curve.axvspan(closure.left, closure.back, color="0.5", alpha=0.2, label="start out of sight")
        curve.legend(fontsize="small")
    return figure
