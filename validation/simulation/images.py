"""Renders a textured world to an image sequence on disk, with ground truth and calibration.

The sequence is an EuRoC ASL folder (M. Burri et al., The EuRoC micro aerial vehicle datasets, 2016):

    mav0/cam0, mav0/cam1       data/<stamp>.png or .jpg, data.csv, sensor.yaml; the body is the left camera
    mav0/depth0                the left camera's depth, 16 bits, in 1/5000 m; 0 is no depth, or one out of range
    mav0/state_groundtruth_estimate0/data.csv
    camera.yaml                the left camera, and the baseline of a stereo pair
    known_points.csv           corners of the first image with known positions
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.ranges import CountOrNone, NotNegative, Positive, Range, Rate, check_ranges
from rbpf.runs.files import OnDone, prepare_folder, write_csv, write_text
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers.images.calibration import camera_text
from rbpf.sensors.readers.known_points import ACROSS, COLUMNS
from rbpf.validation.simulation.paths import Wave
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import ImageWorld, TexturedScene, cast

DRIFT_HZ = 0.1, 0.5
PROBES = 12, 16  #: Rows and columns of the pixels at which the motion blur is measured.
MOST_RAYS = 8  #: Maximum along each side of a pixel; motion blur above 64 px shows gaps.


@dataclass(frozen=True)
class Imaging:
    """Imaging conditions, and the files written beside the images.

    The defaults model a small camera indoors: an exposure time of 10 ms, noise at high gain, automatic exposure and
    vignetting. `examples/studies/mono_realism.py` compares the matches of active search in such images with those in
    real recordings.
    """

    noise_std: NotNegative = 3.0  #: standard deviation of the sensor noise, grey levels.
    exposure_drift: Rate = 0.15  #: largest relative change of the exposure, which varies within seconds.
    lens_px: NotNegative = 0.5  #: standard deviation of the lens's point spread; 0 is an ideal lens.
    blur_s: NotNegative = 0.01  #: exposure time, centred on the stamp.
    vignetting: Rate = 0.2  #: relative loss of light in the corner farthest from the principal point.
    blackout: Sequence[int] = ()  #: dark frames, counted from 0.
    grid: Annotated[int, Range(ge=1, le=64)] = 2  #: rays per pixel along each side.
    depth: bool = False  #: whether depth images are written.
    #: quality of JPEG files, 1 to 100; 0 writes lossless PNG.
    jpeg: Annotated[int, Range(ge=0, le=100)] = 0
    known: CountOrNone = 6  #: number of known points, corners in the first image, at least 4; 0 for none.
    known_std_m: Positive = 0.001  #: standard deviation of these positions, the root of their covariance's trace.

    def __post_init__(self) -> None:
        check_ranges(self)
        if 0 < self.known < 4:
            raise InputError(f"known must be at least 4 points, or 0 for none, got {self.known}")
        if self.known and 0 in self.blackout:
            raise InputError("blackout names frame 0, where the known points are seen: leave it out or set known = 0")


class Shutter:
    """Takes the images of a scene, in any order, as a frame's noise depends only on the seed."""

    def __init__(
        self, scene: TexturedScene, imaging: Imaging, camera: Pinhole, renderer: Renderer, rng: np.random.Generator
    ) -> None:
        self._scene, self._imaging, self._camera, self._renderer = scene, imaging, camera, renderer
        frames = np.arange(len(scene.stamps_ns))
        seconds = 1e-9 * (scene.stamps_ns - scene.stamps_ns[0])
        self._gain = 1.0 + Wave.random(np.array([imaging.exposure_drift]), DRIFT_HZ, rng)(seconds)[:, 0]
        self._gain[list(imaging.blackout)] = 0.0
        before, after = np.maximum(frames - 1, 0), np.minimum(frames + 1, frames[-1])
        poses = scene.world_from_camera
        lapse = np.maximum(seconds[after] - seconds[before], np.finfo(float).tiny)[:, None]
        self._rates = SE3.local(poses[before], poses[after]) / lapse
        #: (T, 3) velocities of the camera in the world, m/s.
        self.velocities = (SE3.translation(poses[after]) - SE3.translation(poses[before])) / lapse
        # Factors (H, W) that decrease with the squared distance from the principal point.
        at = np.indices((camera.height, camera.width))
        square = (at[1] - camera.cx) ** 2 + (at[0] - camera.cy) ** 2
        self._vignette = (1.0 - imaging.vignetting * square / square.max()).astype(np.float32)
        size = np.reshape([camera.height, camera.width], (2, 1, 1))
        rows, columns = (np.indices(PROBES) + 0.5) / np.reshape(PROBES, (2, 1, 1)) * size - 0.5
        self._probe = camera.unproject(np.stack([columns, rows], axis=-1).reshape(-1, 2))
        self._seeds = rng.integers(2**63, size=len(frames))

    def images(self, frame: int, baseline_m: float | None = None) -> list[np.ndarray]:
        """Images (H, W) uint8 of a frame: one, or two with a second camera `baseline_m` to the right."""
        import cv2

        rng, imaging = np.random.default_rng(self._seeds[frame]), self._imaging
        poses = self._poses(frame, rng)
        views = [poses]
        if baseline_m is not None:
            views.append(SE3.compose(poses, SE3.exp([0.0, 0.0, 0.0, baseline_m, 0.0, 0.0])))
        pictures = []
        for view in views:  # Grey levels of the light at the sensor.
            light = self._renderer.image(view)
            if imaging.lens_px > 0.0:
                light = np.asarray(cv2.GaussianBlur(light, (0, 0), imaging.lens_px))
            signal = light * (self._gain[frame] * self._vignette)
            if imaging.noise_std > 0.0:
                signal += imaging.noise_std * rng.standard_normal(signal.shape, dtype=np.float32)
            pictures.append(np.clip(np.rint(signal), 0, 255).astype(np.uint8))
        return pictures

    def _poses(self, frame: int, rng: np.random.Generator) -> np.ndarray:
        """(K, 7) poses during the exposure; K is a square number that grows with the motion blur in pixels."""
        middle, least = self._scene.world_from_camera[frame], self._imaging.grid
        half = 0.5 * self._imaging.blur_s * self._rates[frame]
        if not half.any():
            return middle[None]
        # The largest image motion [px] from middle ⊖ half to middle ⊕ half.
        depth, row = cast(self._scene.rectangles, middle, self._probe)
        ray = np.concatenate([self._probe, np.ones((len(self._probe), 1))], axis=1)[row >= 0]
        points = SE3.transform(middle, depth[row >= 0, None] * ray)
        local = SE3.inverse_transform(SE3.retract(middle, np.stack([-half, half])[:, None]), points)
        seen = self._camera.visible(local).all(axis=0)
        start, end = self._camera.project(local[:, seen])
        travel = float(np.linalg.norm(end - start, axis=-1).max(initial=0.0))
        if travel == 0.0:
            return middle[None]
        side = int(np.clip(np.ceil(np.sqrt(travel)), least, max(least, MOST_RAYS)))
        # The renderer assigns the rays of a pixel to poses in order of their columns, which must not correlate with time.
        moment = (rng.permutation(side * side) + 0.5) / (side * side)
        return SE3.retract(middle, (2.0 * moment - 1.0)[:, None] * half)


#: Distance of corners from the border, as a fraction of the image's size: they stay in view when the camera starts to move.
MIDDLE = 0.15
FLAT = 0.025  #: A corner's planar surroundings, as a fraction of the image width: its patch can be warped.
#: Sheets within this distance, with normals within this angle [rad], are coplanar.
THICK_M, PARALLEL = 0.005, 0.01
#: Maximum number of corners detected, and their least quality, as a fraction of the best (J. Shi, C. Tomasi 1994).
CANDIDATES, QUALITY = 300, 0.01
STRONGEST = 0.5  #: Fraction of the detected corners that is used, at least as many as requested.
#: Corners are collinear if their extent across, in the image, is below this fraction of that along.
LEAST_SPREAD = 0.05


def known_corners(scene: TexturedScene, renderer: Renderer, camera: Pinhole, count: int) -> tuple[Array, Array]:
    """`count` strong corners spread over the middle of the first image; any first few of them are spread, too.

    Returns pixels (M, 2) in the first image and positions (M, 3) in the world, m. Raises InputError: too few, or
    collinear.
    """
    import cv2

    # Coplanar rectangles: each gets the number of the first one in its plane.
    rectangles, pose = scene.rectangles, scene.world_from_camera[0]
    normal = np.array([np.cross(r.across, r.down) for r in rectangles])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    corner = np.array([r.corner for r in rectangles])
    apart = np.einsum("rk,rqk->rq", normal, corner - corner[:, None])
    turned = np.linalg.norm(np.cross(normal[:, None], normal), axis=-1)
    plane = ((np.abs(apart) < THICK_M) & (turned < PARALLEL)).argmax(axis=1)
    seen = renderer.depth(pose)[1]
    planes = np.where(seen >= 0, plane[seen], -1)
    # Corners are detected in the middle, with planar surroundings.
    side = 2 * round(FLAT * camera.width) + 1
    window, label = np.ones((side, side), dtype=np.uint8), planes.astype(np.float32)
    flat = cv2.erode(label, window) == cv2.dilate(label, window)
    middle = np.zeros(planes.shape, dtype=bool)
    top, left = (round(MIDDLE * size) for size in planes.shape)
    middle[top:-top, left:-left] = True
    usable = np.asarray(flat & middle & (planes >= 0)).astype(np.uint8)
    image, least = renderer.image(pose), FLAT * camera.width
    found = cv2.goodFeaturesToTrack(image, CANDIDATES, QUALITY, least, mask=usable, blockSize=5)
    px = np.zeros((0, 2)) if found is None else np.asarray(found, dtype=float).reshape(-1, 2)
    if len(px) < count:
        raise InputError(
            f"the first image of the {scene.name} has {len(px)} corners that can be known, expected {count}: "
            "ask for fewer known points or give the world more contrast"
        )
    # Adaptive non-maximal suppression: of the strongest those farthest from any stronger one, the farthest first
    # (M. Brown, R. Szeliski and S. Winder, Multi-image matching using multi-scale oriented patches, 2005).
    px = px[: max(count, round(STRONGEST * len(px)))]
    stronger = np.where(np.tri(len(px), k=-1, dtype=bool), np.linalg.norm(px[:, None] - px, axis=-1), np.inf)
    px = px[np.argsort(-stronger.min(axis=1), kind="stable")[:count]]
    extent = np.linalg.svd(px - px.mean(axis=0), compute_uv=False)
    if count > 2 and extent[1] < LEAST_SPREAD * extent[0]:
        raise InputError(f"the known points of the {scene.name} lie on a line: use another seed or more points")
    uv = camera.unproject(px)
    depth, _ = cast(rectangles, pose, uv)
    return px, SE3.transform(pose, depth[:, None] * np.concatenate([uv, np.ones((count, 1))], axis=1))


DEPTH_PER_M = 5000.0  #: Scale of a depth image, as in TUM's RGB-D recordings: up to 13 m.
COMPRESSION = 1  #: Level of PNG files, 0 to 9: more does not compress noise much better.

TRUTH_COLUMNS = [
    "#timestamp",
    *[f" p_RS_R_{axis} [m]" for axis in "xyz"],
    *[f" q_RS_{axis} []" for axis in "wxyz"],
    *[f" v_RS_R_{axis} [m s^-1]" for axis in "xyz"],
    *[f" b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"],
    *[f" b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"],
]


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder, renamed on success to `folder`, which must not exist, or be empty; deleted if interrupted."""
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder} exists already: delete it or choose another folder for the images")
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    prepare_folder(partial, "images")
    try:
        yield partial
        partial.replace(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def write_image(path: Path, image: np.ndarray, quality: int = 0) -> None:
    """Writes an image (H, W) uint8 or uint16 as PNG, or as JPEG of quality 1 to 100; its folder must exist."""
    import cv2

    how = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if path.suffix == ".png":
        how = [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION]
        if image.dtype == np.uint8:
            # Huffman coding alone compresses noise as well, in less time.
            how += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    _, encoded = cv2.imencode(path.suffix, image, how)
    path.write_bytes(encoded.tobytes())


def write_sensor(folder: Path, sensor: str, scene: TexturedScene, camera: Pinhole, x_m: float, suffix: str) -> None:
    """Writes a sensor's folder (cam0, cam1 or depth0) with calibration and index; `x_m`: its position on the body's x axis."""
    stamps_ns = scene.stamps_ns
    place = folder / "mav0" / sensor
    (place / "data").mkdir(parents=True)
    rows = ([stamp, f"{stamp}{suffix}"] for stamp in stamps_ns.tolist())
    write_csv(place / "data.csv", ["#timestamp [ns]", "filename"], rows)
    seconds = 1e-9 * float(stamps_ns[-1] - stamps_ns[0])
    rate = (len(stamps_ns) - 1) / seconds if seconds else 0.0
    matrix = np.eye(4)
    matrix[0, 3] = x_m
    # EuRoC has four coefficients; a fifth is written only if it is not zero.
    distortion = camera.distortion if any(camera.distortion[4:]) else camera.distortion[:4]
    lines = [
        "sensor_type: camera",
        f"comment: simulated {scene.name}, {sensor}",
        "T_BS:",
        "  cols: 4",
        "  rows: 4",
        f"  data: {matrix.ravel().tolist()}",
        f"rate_hz: {rate:.6g}",
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: {[float(x) for x in camera.params[:4]]}",
        f"distortion_model: {camera.distortion_model}",
        f"distortion_coefficients: {[float(x) for x in distortion]}",
    ]
    if sensor.startswith("depth"):
        lines.append(f"depth_per_m: {DEPTH_PER_M}")
    (place / "sensor.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def simulate_images(
    world: ImageWorld,
    imaging: Imaging,
    camera: Pinhole | RectifiedStereo,
    folder: Path,
    seed: int,
    on_frame: OnDone | None = None,
    baseline_m: float | None = None,
) -> None:
    """Renders a world into an EuRoC ASL folder; the same arguments give the same bytes.

    Beside mav0 it holds camera.yaml; known_points.csv, if points are known; and chessboard.yaml, if there is a board. The
    folder must not exist, or be empty; it appears once it is complete: an interrupted run leaves nothing. The path is that
    of the left camera; `baseline_m` adds an equal one to the right of a `Pinhole`; a `RectifiedStereo` has its own.
    `on_frame` is called after every image, in order, with the number done and the total.

    Raises InputError: the folder exists, an option names frames beyond the last, too few corners qualify as known points,
    or the baseline is not positive.

    Example:
        >>> import tempfile
        >>> from rbpf.validation.simulation.desk_and_room import TexturedDesk
        >>> camera = Pinhole(80, 60, 50.0, 50.0, 39.5, 29.5)
        >>> folder = Path(tempfile.mkdtemp()) / "desk"
        >>> simulate_images(TexturedDesk(frames=2, texel_m=0.01), Imaging(), camera, folder, seed=0)
        >>> len(list((folder / "mav0" / "cam0" / "data").glob("*.png")))
        2
    """
    import yaml

    rng = np.random.default_rng(seed)
    scene = world.build(rng)
    if wrong := [frame for frame in imaging.blackout if not 0 <= frame < len(scene.stamps_ns)]:
        raise InputError(f"blackout names frame {wrong[0]}, but the frames are 0 to {len(scene.stamps_ns) - 1}")
    left, baseline_m = (camera, baseline_m) if isinstance(camera, Pinhole) else (camera.camera, camera.baseline_m)
    if baseline_m is not None and not baseline_m > 0.0:
        raise InputError(f"the stereo baseline must be positive, got {baseline_m!r} m")
    renderer = Renderer(scene.rectangles, left, imaging.grid)
    shutter, suffix = Shutter(scene, imaging, left, renderer, rng), ".jpg" if imaging.jpeg else ".png"
    with whole_folder(folder) as partial:
        write_sensor(partial, "cam0", scene, left, 0.0, suffix)
        if baseline_m is not None:
            write_sensor(partial, "cam1", scene, left, baseline_m, suffix)
        if imaging.depth:
            write_sensor(partial, "depth0", scene, left, 0.0, ".png")
        write_text(partial / "camera.yaml", camera_text(left, baseline_m=baseline_m))
        # Ground truth: poses and velocities in the world [m/s]; gyroscope biases, which EuRoC has, are 0.
        place, poses = partial / "mav0" / "state_groundtruth_estimate0", scene.world_from_camera
        place.mkdir(parents=True)
        wxyz, biases = np.roll(poses[:, :4], 1, axis=1), np.zeros((len(poses), 6))
        table = np.concatenate([SE3.translation(poses), wxyz, shutter.velocities, biases], axis=1)
        rows = zip(scene.stamps_ns.tolist(), table, strict=True)
        write_csv(place / "data.csv", TRUTH_COLUMNS, ([stamp, *(f"{x:.12g}" for x in row)] for stamp, row in rows))
        if imaging.known:
            px, positions = known_corners(scene, renderer, left, imaging.known)
            per_axis = imaging.known_std_m / np.sqrt(3.0)
            positions = positions + per_axis * rng.standard_normal(positions.shape)
            header, std = [*COLUMNS, ACROSS], (f"{imaging.known_std_m:g}", f"{per_axis:.4g}")
            texts = np.hstack([np.char.mod("%.4f", px), np.char.mod("%.6f", positions)]).tolist()
            write_csv(partial / "known_points.csv", header, ([k, *row, *std] for k, row in enumerate(texts, start=1)))
        if scene.boards:
            # Poses as [qx, qy, qz, qw, x, y, z].
            boards = [vars(board) | {"world_from_board": pose.tolist()} for board, pose in scene.boards]
            write_text(partial / "chessboard.yaml", yaml.safe_dump(boards, sort_keys=False))

        def take(frame: int) -> None:
            stamp = int(scene.stamps_ns[frame])
            for sensor, image in zip(("cam0", "cam1"), shutter.images(frame, baseline_m), strict=False):
                write_image(partial / "mav0" / sensor / "data" / f"{stamp}{suffix}", image, imaging.jpeg)
            if imaging.depth:
                depth, _ = renderer.depth(scene.world_from_camera[frame])
                steps = np.rint(DEPTH_PER_M * depth)
                coded = np.where(steps <= np.iinfo(np.uint16).max, steps, 0.0).astype(np.uint16)
                write_image(partial / "mav0" / "depth0" / "data" / f"{stamp}.png", coded)

        # All frames in parallel, reported in order.
        frames = len(scene.stamps_ns)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            try:
                for done, _ in enumerate(pool.map(take, range(frames)), start=1):
                    if on_frame is not None:
                        on_frame(done, frames)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
