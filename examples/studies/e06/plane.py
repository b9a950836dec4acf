"""Figure 4: coplanarity of the landmarks of a flat desk."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from examples.studies.e06.setting import Row, Setting
from examples.studies.e06.worlds import flat_desk
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.plots import COLOURS, SIGMAS, label, outline, save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.systems.map_estimate import MapEstimate

ASKED_M, GOAL_M = 0.01, 0.003
LEAST = 4


@dataclass(frozen=True)
class Plane:
    """A least-squares plane through points (K, 3).

    Attributes:
        middle: (3,) their mean.
        axes: (3, 3) rows: two directions in the plane and its normal.
        local: (K, 3) the points in these axes, relative to the mean.
        area_m2: of their convex hull in the plane.
    """

    middle: np.ndarray
    axes: np.ndarray
    local: np.ndarray
    area_m2: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the distances from the plane."""
        return float(np.sqrt(np.mean(self.local[:, 2] ** 2)))

    @property
    def worst_m(self) -> float:
        """Largest distance from it."""
        return float(np.abs(self.local[:, 2]).max())


def fit_plane(points: np.ndarray) -> Plane:
    """The least-squares plane of points (K, 3).

    Raises:
        InputError: there are fewer than four.
    """
    from scipy.spatial import ConvexHull

    if len(points) < LEAST:
        raise InputError(f"a plane is fitted to at least {LEAST} landmarks of known depth, the map has {len(points)}")
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    local = (points - middle) @ axes.T
    return Plane(middle, axes, local, float(ConvexHull(local[:, :2]).volume))


def unknown_points(run: Run, mapped: MapEstimate) -> np.ndarray:
    """(M,) which landmarks of a map are full points and were not known points."""
    known = 0 if run.system.known is None else run.system.known.names.size
    return np.asarray(~mapped.is_ray() & (mapped.ids >= known))


def reproduce(setting: Setting) -> list[Row]:
    """Filters 20 s over a flat desk."""
    frames = 60 if setting.quick else 600
    sequence, known = setting.sequence("flat_desk", flat_desk(frames, 0.003 if setting.quick else 0.001))
    run = filter_opened(open_mono(sequence, setting.config(), known))
    mapped = run.system.map()
    full = unknown_points(run, mapped)
    plane = fit_plane(mapped.mean[full])
    save_figures({"figure_4.png": _draw(run, mapped, full, plane)}, setting.out)
    seconds = round(frames / 30)
    what = f"{int(full.sum())} landmarks of a flat desk after {seconds} s, {plane.area_m2:.2f} m²"
    millimetres = f"rms {1e3 * plane.rms_m:.1f} mm, worst {1e3 * plane.worst_m:.1f} mm"
    return [
        Row("Fig. 4", what, "coplanar to within 1 cm, 1 m²", millimetres, plane.rms_m, plane.rms_m <= ASKED_M),
        Row("Fig. 4", "the same, our own goal", "3 mm", millimetres, plane.rms_m, plane.rms_m <= GOAL_M),
    ]


def _draw(run: Run, mapped: MapEstimate, full: np.ndarray, plane: Plane) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.5), layout="constrained")
    image, above, side = figure.subplots(1, 3)
    frame = next(run.source.frames(run.log.stamps_ns.size // 2))
    image.imshow(frame.image, cmap="gray", vmin=0, vmax=255)
    image.set(title="a view of the desk", xticks=[], yticks=[])
    cov = plane.axes @ mapped.cov[full] @ plane.axes.T
    camera = (SE3.translation(run.log.poses) - plane.middle) @ plane.axes.T
    if camera[:, 2].mean() < 0.0:
        camera[:, 2] *= -1.0
        plane.local[:, 2] *= -1.0
    for axes, pair, name in ((above, (0, 1), "from above"), (side, (0, 2), "from the side")):
        label(axes, f"map with {SIGMAS:g}σ ellipses, {name} (Fig. 4)", "m", "m", equal=True)
        chosen = list(pair)
        for ellipse in outline(plane.local[:, chosen], cov[:, chosen][:, :, chosen]):
            axes.plot(*ellipse.T, color=COLOURS["map"], lw=0.6)
        axes.plot(*plane.local[:, chosen].T, ".", color="black", ms=3, label="landmarks")
        axes.plot(*camera[:, chosen].T, color=COLOURS["filter"], lw=0.8, label="camera")
    above.legend(fontsize="small")
    return figure
