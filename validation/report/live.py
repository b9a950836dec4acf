"""A run in the Rerun viewer (https://rerun.io), live, or as a file written without a display.

world/camera                   the camera's pose; of a robot world/body
world/camera/image             the frames, with searched and matched features
world/uncertainty              3σ ellipsoid of the position
world/seen                     points observed in the frame
world/path, world/odometry     the path, and that of the odometry alone; at the end also the ground truth
world/map                      the map: points with 3σ ellipsoids, rays as lines, walls; known points
plots/…                        figures over the frames

A new system needs a function that logs a frame's features, entered into `DRAWN`; others have path, map and figures.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.checkpoint import whole
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import prepare_folder
from rbpf.runs.plots import SIGMAS, near_box, outline, position_covariances
from rbpf.runs.reading import PathAndMap
from rbpf.runs.run import Run
from rbpf.runs.trajectory import fit, in_space
from rbpf.systems.laser.slam import LaserSlam
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.stereo.landmarks import FeatureKind
from rbpf.systems.system import Tracked
from rbpf.validation.report.video import FEATURES, FOUND, MISSED, RAY, STARTED

JPEG_QUALITY = 75  #: Quality of the JPEG images in the recording, in per cent.
AXIS_M = 0.1  #: Length of the camera's drawn image plane from its centre.
NEAREST = 0.02  #: Homogeneous weight below which an observed point counts as at infinity and is left out, 1/m.
PATH, ODOMETRY, TRUE = (31, 119, 180), (127, 127, 127), (255, 255, 255)
#: Path and map are logged again once the run is longer by this fraction and this many frames.
GROWTH, LEAST_FRAMES = 0.05, 10


def require_rerun() -> Any:
    """The package. Raises InputError: it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            "--view and --rerun need the package rerun-sdk, which is not installed: pip install 'rbpf[viewing]', or leave "
            "them out"
        ) from error
    return rerun


class RunView:
    """Shows a run in a stream of Rerun's: a listener of `rbpf.runs.run.drive`, called after each frame."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self._next = 0  # frame at which path and map are logged again
        self._start_ns = 0

    def __call__(self, run: Run, tracked: Tracked) -> None:
        self.show(run, len(run.log) - 1, tracked, getattr(run.frame, "image", None))
        if len(run.log) > self._next:
            self._next = len(run.log) + max(LEAST_FRAMES, int(GROWTH * len(run.log)))
            self.map(run)

    def show(self, run: Run, t: int, tracked: Tracked, image: np.ndarray | None) -> None:
        """Logs frame t of a run, the system's result, and its image, if there is one."""
        rr, stream, system = self.rr, self.stream, run.system
        camera, (drawn, plotted) = _lens(system), DRAWN.get(system.name, (None, {}))
        if not self._next:
            self._next, self._start_ns = 1, tracked.stamp_ns
            stream.send_blueprint(blueprint(run))
            if camera is not None:
                # Rerun's pixels start at a corner, not at a centre.
                lens = rr.Pinhole(
                    focal_length=[camera.fx, camera.fy],
                    principal_point=[camera.cx + 0.5, camera.cy + 0.5],
                    resolution=[camera.width, camera.height],
                    camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=AXIS_M,
                )
                stream.log("world/camera", lens, static=True)
            known = getattr(system, "known_points", None)
            if known is not None:
                stream.log("world/known_points", rr.Points3D(known.positions, colors=[FOUND], radii=0.01), static=True)
            for name, colour in plotted.items():
                stream.log(f"plots/tracking/{name}", rr.SeriesLines(colors=[colour], names=[name]), static=True)
        now, values = PathAndMap(np.zeros(1, dtype=np.int64), tracked.pose[None], tracked.cov[None]), tracked.values
        pose = now.trajectory.world_from_body[0]
        log_time(stream, t, tracked.stamp_ns - self._start_ns)
        body = "camera" if camera is not None else "body"
        log_pose(rr, stream, body, pose)
        if body == "body":
            stream.log("world/body", rr.TransformAxes3D(1.0))
        if image is not None:
            stream.log("world/camera/image", rr.Image(image).compress(jpeg_quality=JPEG_QUALITY))
        at = MapEstimate(np.zeros(1, dtype=int), pose[None, 4:], position_covariances(now))
        stream.log("world/uncertainty", ellipsoids(rr, at))
        if drawn is not None:
            drawn(rr, stream, run, tracked.observed, pose)
        figures = {"filter/ess": values["ess"]} | {f"tracking/{name}": values[name] for name in plotted}
        if values["nis_dof"] > 0:
            figures["filter/nis_per_dof"] = values["nis"] / values["nis_dof"]
        for name, value in figures.items():
            stream.log(f"plots/{name}", rr.Scalars(float(value)))

    def map(self, run: Run, static: bool = False) -> None:
        """Logs the current path and map; `static` for all frames."""
        rr, stream, log = self.rr, self.stream, run.log
        stamps = log.stamps_ns
        paths = {"path": (log.poses, PATH)} | ({"odometry": (log["odometry"], ODOMETRY)} if "odometry" in log else {})
        for name, (poses, colour) in paths.items():
            positions = in_space(stamps, poses).positions
            stream.log(f"world/{name}", rr.LineStrips3D([positions], colors=[colour]), static=static)
        if isinstance(run.system, LaserSlam):
            walls = rr.Points3D(_places(run), radii=0.5 * run.system.picture().cell_m)
            stream.log("world/map/walls", walls, static=static)
            return
        found = run.system.map()
        stream.log("world/map/points", ellipsoids(rr, found.points()), static=static)
        if found.ray_ends is not None:
            rays = rr.LineStrips3D(found.ray_ends[found.is_ray()], colors=[RAY])
            stream.log("world/map/rays", rays, static=static)

    def finish(self, run: Run) -> None:
        """Logs the whole path and the final map, all in view, and the ground truth in the run's own world."""
        self.map(run, static=True)
        self.stream.send_blueprint(blueprint(run))
        if run.truth is not None:
            stamps = run.log.stamps_ns[run.truth.rows]
            true, ours = (in_space(stamps, poses) for poses in (run.truth.poses, run.log.poses[run.truth.rows]))
            moved = fit(run.truth.alignment, true.positions, ours.positions)
            line = self.rr.LineStrips3D([moved.transform(true.positions)], colors=[TRUE])
            self.stream.log("world/truth", line, static=True)


def blueprint(run: Run) -> Any:
    """The viewer's layout: the world, next to it the image if there is one, and the figures.

    The view is from behind and above the first pose, so that the path and the nearby map are visible. By default the viewer
    would include the far ends of rays, and all else would be tiny.
    """
    import rerun.blueprint as rrb

    curves = {"plots/filter/ess": "effective sample size", "plots/filter/nis_per_dof": "NIS per degree of freedom"}
    if len(run.log) > 1 and not (run.log["nis_dof"] > 0.0).any():
        del curves["plots/filter/nis_per_dof"]  # the measurements are not Gaussian innovations
    images = [rrb.Spatial2DView(origin="world/camera/image", name="image")] if run.system.name in DRAWN else []
    curves |= {"plots/tracking": "tracking"} if images else {}
    beside = [*images, *(rrb.TimeSeriesView(origin=origin, name=name) for origin, name in curves.items())]
    path = in_space(run.log.stamps_ns, run.log.poses)
    first, (_, low, high) = SE3.rotation(path.world_from_body[0]), near_box(_places(run), path.positions)
    camera = _lens(run.system) is not None
    up, ahead = (-first[:, 1], first[:, 2]) if camera else (first[:, 2], first[:, 0])
    middle, size = 0.5 * (low + high), max(float((high - low).max()), 10.0 * AXIS_M)
    eye = rrb.EyeControls3D(position=middle + size * (0.8 * up - 0.8 * ahead), look_target=middle, eye_up=up)
    world = rrb.Spatial3DView(origin="world", name="path and map", eye_controls=eye, line_grid=False)
    column = rrb.Vertical(*beside, row_shares=[2] * len(images) + [1] * len(curves))
    return rrb.Blueprint(rrb.Horizontal(world, column, column_shares=[3, 2]), collapse_panels=True)


def _places(run: Run) -> np.ndarray:
    """Points (M, 3) of the current map: for a scanner the centres of wall cells, else points of known depth."""
    if not isinstance(run.system, LaserSlam):
        return run.system.map().points().in_space()[0]
    return np.pad(run.system.picture().walls(), ((0, 0), (0, 1)))


def _lens(system: Any) -> Any:
    """The camera of the images, or None."""
    return system.rig.camera if hasattr(system, "rig") else getattr(system, "camera", None)


@contextmanager
def viewer(name: str) -> Iterator[RunView]:
    """Opens the viewer's window, for a run of this name. Raises InputError: it is not installed, or cannot be opened."""
    rr = require_rerun()
    with rr.RecordingStream("rbpf", recording_id=_readable(name)) as stream:
        try:
            stream.spawn()
        except (OSError, RuntimeError) as error:
            raise InputError(f"the Rerun viewer cannot be opened ({error}): leave out --view") from error
        yield RunView(rr, stream)
        stream.flush()


def write_rerun(run: Run, path: Path) -> None:
    """Writes the recording (.rrd) of a run, whose source is read once more.

    Raises InputError: Rerun is not installed, or the file cannot be written.
    """
    with recording(path, run.name) as (rr, stream):
        view, log = RunView(rr, stream), run.log
        arrays, states = (log.stamps_ns.tolist(), log.poses, log.covs), log.states
        columns = {column.name: log[column.name] for column in run.system.columns}
        for t, frame in zip(range(len(log)), run.source.frames(), strict=False):
            stamp_ns, pose, cov = (each[t] for each in arrays)
            values = {name: column[t] for name, column in columns.items()}
            tracked = Tracked(stamp_ns, pose, cov, states[t], values, log.observed(t))
            view.show(run, t, tracked, getattr(frame, "image", None))
        view.finish(run)


def _readable(name: str) -> str:
    """A name without bytes that are not UTF-8, which file names may contain."""
    return name.encode(errors="replace").decode()


@contextmanager
def recording(path: Path, name: str) -> Iterator[tuple[Any, Any]]:
    """The package and a stream into a file (.rrd), which appears once it is complete. Errors as of `write_rerun`."""
    rr = require_rerun()
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: Rerun writes to no path that is not UTF-8: choose another name") from error
    prepare_folder(path.parent)
    with whole(path) as partial, rr.RecordingStream("rbpf", recording_id=_readable(name)) as stream:
        stream.save(str(partial))
        yield rr, stream
        stream.flush()


def log_time(stream: Any, t: int, after_ns: int) -> None:
    """Sets a frame's number and time since the first one [ns] for the following logs."""
    stream.set_time("frame", sequence=t)
    stream.set_time("time", duration=1e-9 * float(after_ns))


def log_pose(rr: Any, stream: Any, name: str, pose: np.ndarray) -> None:
    """Logs the pose (7,) of a camera or a robot in the world."""
    turned = rr.Quaternion(xyzw=pose[:4])
    stream.log(f"world/{name}", rr.Transform3D(translation=SE3.translation(pose), quaternion=turned))


def ellipsoids(rr: Any, landmarks: MapEstimate) -> Any:
    """A map's 3σ ellipsoids, with the landmarks' names; those of the plane lie at z = 0."""
    mean, cov = landmarks.in_space()
    values, vectors = np.linalg.eigh(cov)
    turned = vectors * np.where(np.linalg.det(vectors) < 0.0, -1.0, 1.0)[:, None, None]
    return rr.Ellipsoids3D(
        centers=mean,
        half_sizes=SIGMAS * np.sqrt(np.maximum(values, 0.0)),
        quaternions=SE3.from_matrix(np.concatenate([turned, mean[..., None]], axis=-1))[:, :4],
        labels=[str(name) for name in landmarks.ids],
        show_labels=False,
    )


def _log_search(rr: Any, stream: Any, run: Run, seen: Mapping[str, np.ndarray], pose: np.ndarray) -> None:
    """Logs the searched features; in Rerun, pixel coordinates start at a pixel's corner."""
    found = np.isfinite(seen["px"]).all(axis=1)
    ellipses = outline(seen["mean"], seen["cov"]) + 0.5
    for name, chosen, colour in (("found", found, FOUND), ("missed", ~found, MISSED)):
        stream.log(f"world/camera/image/{name}/ellipses", rr.LineStrips2D(ellipses[chosen], colors=[colour]))
    stream.log("world/camera/image/found/places", rr.Points2D(seen["px"][found] + 0.5, colors=[FOUND]))
    stream.log("world/camera/image/new", rr.Points2D(seen["started_px"] + 0.5, colors=[STARTED]))
    lines = seen["line"][np.isfinite(seen["line"]).all(axis=(1, 2))] + 0.5
    stream.log("world/camera/image/epipolar_lines", rr.LineStrips2D(lines, colors=[RAY]))
    near = found & (seen["position"][:, 3] >= NEAREST)
    places = seen["position"][near, :3] / seen["position"][near, 3:]
    stream.log("world/seen", rr.Points3D(places, colors=[FOUND], radii=0.005))


def _log_pair(rr: Any, stream: Any, run: Run, seen: Mapping[str, np.ndarray], pose: np.ndarray) -> None:
    """Logs features of the left image by their role in the map, and landmarks triangulated from the pair alone."""
    for kind, (name, colour) in FEATURES.items():
        pixels = rr.Points2D(seen["z"][seen["kind"] == kind, :2] + 0.5, colors=[colour], radii=rr.Radius.ui_points(3.0))
        stream.log(f"world/camera/image/{name}", pixels)
    rig = run.system.rig
    places = SE3.transform(pose, rig.triangulate(seen["z"][seen["kind"] == FeatureKind.LANDMARK]))
    stream.log("world/seen", rr.Points3D(places, colors=[FOUND], radii=0.005))


#: By the system's name, the function that logs a frame's features, and system-specific figures with their colours.
DRAWN: Mapping[str, tuple[Callable[..., None], Mapping[str, tuple[int, int, int]]]] = {
    "mono": (_log_search, {"searched": ODOMETRY, "found": FOUND, "lost": MISSED}),
    "stereo": (_log_pair, {"features": ODOMETRY, "agreeing": PATH, "observed": FOUND}),
}
