"""From where a camera's world is drawn: from above and from the side, along the axis that is most nearly vertical."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.plots import COLOURS, SIGMAS, label, outline

_UPRIGHT = 0.05
"""Weight of the direction of the images' upper side beside that of their rows, which do not tilt with the camera."""


@dataclass(frozen=True)
class Views:
    """Two views along axes of the world.

    Attributes:
        top: the axes to the right and up the page, seen from above.
        side: likewise seen from the side.
        down: whether the vertical axis points down, as a camera's y axis does.
    """

    top: tuple[int, int]
    side: tuple[int, int]
    down: bool

    def axes(self, title: str) -> tuple[Any, list[tuple[Any, tuple[int, int]]]]:
        """A figure, and its two pairs of axes with the world's axes that they show."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(13.0, 6.0), layout="constrained")
        shown = list(zip(figure.subplots(1, 2), (self.top, self.side), strict=True))
        for (axes, (right, up)), view in zip(shown, ("from above", "from the side"), strict=True):
            label(axes, f"{title}, seen {view}", f"{'xyz'[right]} [m]", f"{'xyz'[up]} [m]", equal=True)
        if self.down:
            shown[1][0].invert_yaxis()
        return figure, shown


def best_views(world_from_camera: np.ndarray) -> Views:
    """The views for a path (T, 7): a camera is seldom rolled, so that the vertical is square to its images' rows."""
    turn = SE3.matrix(world_from_camera)[:, :3, :3]
    upper = -turn[:, :, 1].mean(axis=0)
    score = np.square(turn[:, :, 0]).mean(axis=0) - _UPRIGHT * np.abs(upper)
    vertical = int(np.argmin(score))
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    down = bool(upper[vertical] < 0.0)
    top = (second, first) if down else (first, second)
    return Views(top, (top[0], vertical), down)


def close_up(axes: Any, shown: tuple[int, int], points: np.ndarray) -> None:
    """Limits that hold points (K, 3) with a margin; what is far away (rays) runs out of the picture."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * max(float((high - low).max()), 1e-3)
    axes.set_xlim(middle[shown[0]] - half, middle[shown[0]] + half)
    ends = middle[shown[1]] - half, middle[shown[1]] + half
    axes.set_ylim(*(reversed(ends) if axes.yaxis_inverted() else ends))
    axes.set_aspect("equal", adjustable="box")


def draw_particles(
    shown: list[tuple[Any, tuple[int, int]]],
    at: np.ndarray,
    weights: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
) -> None:
    """Particles (N, 3) with weights (N,), and mean (3,) and covariance (3, 3) of the position, in all views."""
    for axes, (right, up) in shown:
        axes.scatter(
            at[:, right], at[:, up], s=1000 * weights, color=COLOURS["filter"], alpha=0.5,
            label="particles; area is weight",
        )  # fmt: skip
        chosen = [right, up]
        ellipse = outline(mean[chosen], cov[np.ix_(chosen, chosen)])
        axes.plot(*ellipse.T, color=COLOURS["map"], lw=1.0, label=f"{SIGMAS:g}σ of the pose")
        axes.plot(mean[right], mean[up], "x", color=COLOURS["map"], label="mean")
        axes.ticklabel_format(useOffset=False)
        axes.tick_params(axis="x", labelrotation=30)
    shown[0][0].legend(loc="best", fontsize="small")
