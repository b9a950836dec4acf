"""What was looked for and seen in each frame of a run over images: an annotated video, and a recording for the Rerun viewer.

A further system is one function from a run and the number of a frame to a picture, entered into `PICTURES`, and one that
logs a frame, entered into `DRAWN`. A recording (https://rerun.io) is written without a screen:

world/camera                   the camera's pose; of a robot world/body
world/camera/image             the frames, with what was looked for and seen in them
world/seen                     points that were seen in the frame
world/path, world/odometry     the whole path, and that of the odometry alone
world/map                      the final map: points with 3σ ellipsoids, rays as lines; known points
plots/…                        figures over the frames
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import OnDone, prepare_folder, whole
from rbpf.runs.plots import SIGMAS, outline
from rbpf.runs.run import Run
from rbpf.sensors.readers import ImageFrame
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.stereo.landmarks import FeatureKind

Colour = tuple[int, int, int]
Place = Callable[[np.ndarray], list[tuple[float, float]]]  #: Pixels (…, 2) of the image to points of the picture.
FOUND, MISSED, STARTED, TEXT = (60, 220, 60), (240, 60, 50), (90, 170, 255), (255, 255, 255)
_SMALL_PX = 800  #: Images that are narrower are drawn at twice their size: an ellipse of three pixels shows nothing.
_ARM, _BAND = 4, 24
#: Height of letters as a fraction of the drawn width, and its bounds, px.
_LETTER_FRACTION, _SMALLEST, _LARGEST = 1.0 / 62.0, 11.0, 17.0


def drawn_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of a drawn frame, even numbers, as video needs them."""
    scale = drawn_scale(width)
    return scale * width + (scale * width) % 2, scale * height + _BAND + (scale * height + _BAND) % 2


def drawn_scale(width: int) -> int:
    """How many times an image of this width is enlarged."""
    return 2 if width < _SMALL_PX else 1


def annotate(
    image: np.ndarray | None,
    size: tuple[int, int],
    caption: tuple[str, str],
    legend: Sequence[tuple[str, Colour]],
    paint: Callable[[Any, Place], None],
) -> np.ndarray:
    """The frame (H, W, 3) uint8 as it is shown, under a caption (figures, warning) and a legend of names and colours.

    The image is (height, width) uint8 of a size (width, height), or None where it could not be read. `paint` is called with
    PIL's drawing of the picture, and with what tells where a pixel lies in it.
    """
    from PIL import Image, ImageDraw, ImageFont

    scale, drawn = drawn_scale(size[0]), drawn_size(*size)
    picture = Image.new("RGB", drawn)
    if image is not None:
        shown = Image.fromarray(image).resize((scale * size[0], scale * size[1]), Image.Resampling.BILINEAR)
        picture.paste(shown.convert("RGB"), (0, _BAND))
    draw = ImageDraw.Draw(picture)
    draw.font = ImageFont.load_default(min(max(_LETTER_FRACTION * drawn[0], _SMALLEST), _LARGEST))

    def place(px: np.ndarray) -> list[tuple[float, float]]:
        shifted = scale * (np.atleast_2d(px) + 0.5) - 0.5 + [0.0, _BAND]
        return [(float(x), float(y)) for x, y in shifted]

    paint(draw, place)
    draw.rectangle((0, 0, drawn[0], _BAND), fill=(0, 0, 0))
    text, alarm = caption
    draw.text((4, 3), text, fill=TEXT)
    draw.text((draw.textlength(text) + 16, 3), alarm, fill=MISSED)
    at = drawn[0] - 6.0
    for name, colour in reversed(legend):
        at -= draw.textlength(name)
        draw.text((at, 3), name, fill=colour)
        at -= 12.0
    return np.asarray(picture)


def cross(draw: Any, at: tuple[float, float], colour: Colour) -> None:
    """A small upright cross at a point of the picture."""
    x, y = at
    draw.line((x - _ARM, y, x + _ARM, y), fill=colour)
    draw.line((x, y - _ARM, x, y + _ARM), fill=colour)


RAY = (255, 190, 40)
_SEARCH_LEGEND = (("found", FOUND), ("missed", MISSED), ("epipolar line", RAY), ("new", STARTED))


def picture_of_search(run: Run, t: int, frame: ImageFrame) -> np.ndarray:
    """A frame of a monocular run (H, W, 3): ellipses, hits, misses and epipolar lines (E06, Figs. 7 and 8)."""
    log = run.log
    found, searched = log["found"][t], log["searched"][t]
    seen = f"found {found} of {searched}" if searched else f"starts from {found} points" if found else ""
    text = f"frame {t}   {seen}   map {log['points'][t]} points, {log['rays'][t]} rays"
    alarm = "FOUND AGAIN" if log["relocalised"][t] else "LOST" if log["lost"][t] else ""
    alarm = f"NO IMAGE {alarm}" if frame.image is None else alarm
    camera = run.system.camera
    return draw_search(frame.image, log.observed(t), (text, alarm), (camera.width, camera.height))


def draw_search(
    image: np.ndarray | None, seen: Mapping[str, np.ndarray], caption: tuple[str, str], size: tuple[int, int]
) -> np.ndarray:
    """The frame (H, W, 3) uint8 of a size (width, height), with what was looked for in it, see `MonoSlam.observed`."""
    found, stroke = np.isfinite(seen["px"]).all(axis=1), drawn_scale(size[0])

    def paint(draw: Any, place: Place) -> None:
        for line in seen["line"][np.isfinite(seen["line"]).all(axis=(1, 2))]:
            draw.line(place(_clipped(line, size)), fill=RAY, width=stroke)
        for ellipse, hit in zip(outline(seen["mean"], seen["cov"]), found.tolist(), strict=True):
            draw.line(place(ellipse), fill=FOUND if hit else MISSED, width=stroke)
        for name, rows, colour in (("px", found, FOUND), ("mean", ~found, MISSED), ("started_px", ..., STARTED)):
            for px in seen[name][rows]:
                cross(draw, place(px)[0], colour)

    return annotate(image, size, caption, _SEARCH_LEGEND, paint)


def _clipped(line: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A line (2, 2) without what lies more than an image's size outside: far ends may project to anywhere."""
    start, step = line[0], line[1] - line[0]
    low, high = -np.asarray(size, dtype=float), 2.0 * np.asarray(size, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(low - start) / step, (high - start) / step]), axis=0)
    enter = max(0.0, float(np.nanmax(np.where(step == 0.0, 0.0, ends[0]))))
    leave = min(1.0, float(np.nanmin(np.where(step == 0.0, 1.0, ends[1]))))
    return start + np.array([[enter], [max(enter, leave)]]) * step


#: Names and colours of what a feature of a pair is to the map, in the order in which they are drawn.
FEATURES: Mapping[FeatureKind, tuple[str, Colour]] = {
    FeatureKind.FEATURE: ("feature", (150, 150, 150)),
    FeatureKind.CANDIDATE: ("candidate", (255, 190, 40)),
    FeatureKind.LANDMARK: ("landmark", FOUND),
    FeatureKind.NEW: ("new", STARTED),
}


def picture_of_pair(run: Run, t: int, frame: ImageFrame) -> np.ndarray:
    """A frame of a stereo run (H, W, 3): the left image, with what each of its features was to the map.

    A line leads from each to where the right camera has it.
    """
    log = run.log
    held = f"{log['observed'][t]} landmarks" if log["updated"][t] else "no update"
    text = f"pair {t}   {log['features'][t]} features   {log['agreeing'][t]} agree   {held}"
    alarm = "" if t == 0 or log["agreeing"][t] else "NO MOTION FOUND"
    if frame.image is None or frame.right is None:
        alarm = "NO PAIR"
    camera, seen = run.system.rig.camera, log.observed(t)

    def paint(draw: Any, place: Place) -> None:
        for kind, (_, colour) in FEATURES.items():
            for u, v, right in seen["z"][seen["kind"] == kind].tolist():
                draw.line(place(np.array([[u, v], [right, v]])), fill=colour, width=drawn_scale(camera.width))
                cross(draw, place(np.array([u, v]))[0], colour)

    return annotate(frame.image, (camera.width, camera.height), (text, alarm), list(FEATURES.values()), paint)


#: By the system's name, how a frame is drawn.
PICTURES: dict[str, Callable[[Run, int, ImageFrame], np.ndarray]] = {
    "mono": picture_of_search,
    "stereo": picture_of_pair,
}


def annotated_frames(run: Run) -> Iterator[np.ndarray]:
    """The frames of a run (H, W, 3) uint8, as they are needed; its source is read once more."""
    draw = PICTURES[run.system.name]
    for t, frame in zip(range(len(run.log)), run.source.frames(), strict=False):
        yield draw(run, t, frame)


#: Bounds of the time per image, for sequences whose stamps say little: photos, equal stamps.
SHORTEST_S, LONGEST_S = 1.0 / 120.0, 1.0
RATE_FACTOR = "23"  #: Constant rate factor of H.264: 18 is nearly without loss, 28 poor.
ENCODING = "-preset", "veryfast", "-fflags", "+bitexact", "-flags:v", "+bitexact"


def write_video(
    pictures: Iterator[np.ndarray], stamps_ns: np.ndarray, path: Path, on_frame: OnDone | None = None
) -> None:
    """Writes an MP4 of pictures (H, W, 3) uint8, one or more of one size, even numbers, as fast as their stamps (T,).

    It appears under its name when it is complete; an InputError says that the place cannot be written to. `on_frame` is called
    with the pictures written and their number.
    """
    import imageio_ffmpeg

    first = next(pictures)
    with whole(path) as partial:
        encoder = imageio_ffmpeg.write_frames(
            str(partial.absolute()),
            first.shape[1::-1],
            fps=frame_rate(stamps_ns),
            codec="libx264",
            quality=None,
            macro_block_size=2,
            pix_fmt_out="yuv420p",
            output_params=["-crf", RATE_FACTOR, *ENCODING],
            ffmpeg_log_level="error",
        )
        with closing(encoder):
            encoder.send(None)
            for t, picture in enumerate(chain([first], pictures)):
                encoder.send(np.ascontiguousarray(picture))
                if on_frame is not None:
                    on_frame(t + 1, stamps_ns.size)
        if not is_complete(partial):
            # The encoder says nothing through the pipe of what went wrong behind it.
            raise OSError("the encoder could not finish, the disk may be full")


def is_complete(path: Path) -> bool:
    """Whether an MP4 holds all that it announces: its boxes fill the file, and the frames' index is among them."""
    size, place, kinds = path.stat().st_size, 0, list[bytes]()
    with path.open("rb") as file:
        while place + 8 <= size:
            file.seek(place)
            length, kind = int.from_bytes(file.read(4), "big"), file.read(4)
            if length == 1:
                length = int.from_bytes(file.read(8), "big")
            if length < 8:
                return False
            kinds.append(kind)
            place += length
    return place == size and b"moov" in kinds


def frame_rate(stamps_ns: np.ndarray) -> float:
    """Images per second of a video that runs as fast as the recording."""
    gaps = np.diff(stamps_ns) * 1e-9
    gaps = gaps[gaps > 0.0]
    typical = float(np.median(gaps)) if gaps.size else LONGEST_S
    return round(1.0 / min(max(typical, SHORTEST_S), LONGEST_S), 3)


JPEG_QUALITY = 75  #: Of the JPEG images in the recording, in per cent.
AXIS_M = 0.1  #: Length of the camera's drawn image plane from its centre.
NEAREST = 0.02  #: Homogeneous weight below which a point that was seen counts as at infinity and is left out, 1/m.


def require_rerun() -> Any:
    """The package; an InputError where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            "--rerun needs the package rerun-sdk, which is not installed: pip install 'rbpf[viewing]', or leave it out"
        ) from error
    return rerun


def write_rerun(run: Run, path: Path) -> None:
    """Writes the recording (.rrd) of a run over images, whose source is read once more.

    Raises InputError: Rerun is not installed, or the file cannot be written.
    """
    log, (log_seen, plots) = run.log, DRAWN[run.system.name]
    stamps, poses, plotted = log.stamps_ns, log.poses, {name: log[name] for name in plots}
    with recording(path, run.name) as (rr, stream):
        # Rerun's pixels start at a corner, not at a centre.
        camera = run.system.camera if run.system.name == "mono" else run.system.rig.camera
        lens = rr.Pinhole(
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + 0.5, camera.cy + 0.5],
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=AXIS_M,
        )
        stream.log("world/camera", lens, static=True)
        stream.log("world/path", rr.LineStrips3D([SE3.translation(poses)]), static=True)
        if "odometry" in log:
            stream.log("world/odometry", rr.LineStrips3D([SE3.translation(log["odometry"])]), static=True)
        found = run.system.map()
        stream.log("world/map/points", ellipsoids(rr, found.points()), static=True)
        if found.ray_ends is not None and found.is_ray().any():
            rays = rr.LineStrips3D(found.ray_ends[found.is_ray()], colors=[RAY])
            stream.log("world/map/rays", rays, static=True)
        known = getattr(run.system, "known_points", None)
        if known is not None:
            stream.log("world/known_points", rr.Points3D(known.positions, colors=[FOUND], radii=0.01), static=True)
        for t, frame in zip(range(len(log)), run.source.frames(), strict=False):
            log_time(stream, t, int(stamps[t] - stamps[0]))
            if frame.image is not None:
                stream.log("world/camera/image", rr.Image(frame.image).compress(jpeg_quality=JPEG_QUALITY))
            log_pose(rr, stream, "camera", poses[t])
            log_seen(rr, stream, run, log.observed(t), poses[t])
            for name, values in plotted.items():
                stream.log(f"plots/{name}", rr.Scalars(float(values[t])))


@contextmanager
def recording(path: Path, name: str) -> Iterator[tuple[Any, Any]]:
    """The package and a stream into a file (.rrd); the file appears when it is complete. Errors as of `write_rerun`."""
    rr = require_rerun()
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: Rerun writes to no path that is not UTF-8: choose another name") from error
    prepare_folder(path.parent)
    readable = name.encode(errors="replace").decode()  # bytes of a file's name that are no UTF-8
    with whole(path) as partial, rr.RecordingStream("rbpf", recording_id=readable) as stream:
        stream.save(str(partial))
        yield rr, stream
        stream.flush()


def log_time(stream: Any, t: int, after_ns: int) -> None:
    """Number of a frame and time since the first one [ns]; what is logged next belongs to it."""
    stream.set_time("frame", sequence=t)
    stream.set_time("time", duration=1e-9 * float(after_ns))


def log_pose(rr: Any, stream: Any, name: str, pose: np.ndarray) -> None:
    """Where a camera or a robot is in the world, (7,)."""
    turned = rr.Quaternion(xyzw=pose[:4])
    stream.log(f"world/{name}", rr.Transform3D(translation=SE3.translation(pose), quaternion=turned))


def ellipsoids(rr: Any, landmarks: MapEstimate) -> Any:
    """A map's 3σ ellipsoids, with the landmarks' names; those of the plane lie at z = 0."""
    mean, cov = landmarks.in_space()
    values, vectors = np.linalg.eigh(cov)
    turned = vectors * np.where(np.linalg.det(vectors) < 0.0, -1.0, 1.0)[:, None, None]
    poses = np.concatenate([turned, mean[..., None]], axis=-1)
    return rr.Ellipsoids3D(
        centers=mean,
        half_sizes=SIGMAS * np.sqrt(np.maximum(values, 0.0)),
        quaternions=SE3.from_matrix(poses)[:, :4],
        labels=[str(name) for name in landmarks.ids],
        show_labels=False,
    )


def _log_search(rr: Any, stream: Any, run: Run, seen: Mapping[str, np.ndarray], pose: np.ndarray) -> None:
    """Features that were looked for; Rerun's pixels start at a corner, not at a centre."""
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
    """Features of the left image by what they were to the map, and where the pair itself has its landmarks."""
    for kind, (name, colour) in FEATURES.items():
        pixels = rr.Points2D(seen["z"][seen["kind"] == kind, :2] + 0.5, colors=[colour])
        stream.log(f"world/camera/image/{name}", pixels)
    rig = run.system.rig
    places = SE3.transform(pose, rig.triangulate(seen["z"][seen["kind"] == FeatureKind.LANDMARK]))
    stream.log("world/seen", rr.Points3D(places, colors=[FOUND], radii=0.005))


#: By the system's name, what logs what a frame showed, and which figures are plotted.
DRAWN = {"mono": (_log_search, ("found", "lost")), "stereo": (_log_pair, ("features", "agreeing", "observed"))}
