"""Simulates what a camera sees of a textured world: an image sequence on disk, with ground truth and calibration."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.simulation.asl import (
    coded_depth,
    image_path,
    whole_folder,
    write_calibration,
    write_image,
    write_sensor,
    write_truth,
)
from rbpf.validation.simulation.exposure import Imaging, Shutter
from rbpf.validation.simulation.known_corners import known_corners
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import ImageWorld, TexturedScene
from rbpf.validation.simulation.wheel_odometer import write_wheel_odometry

OnFrame = Callable[[int, int], None]
"""Told how many images are done, and how many there will be."""


def simulate_images(
    world: ImageWorld,
    imaging: Imaging,
    camera: Pinhole | RectifiedStereo,
    folder: Path,
    seed: int,
    on_frame: OnFrame | None = None,
    baseline_m: float | None = None,
) -> None:
    """Takes pictures of a world and writes them as an EuRoC ASL folder; the same arguments give the same bytes.

    Beside mav0 there are camera.yaml; known_points.csv, if points are known; chessboard.yaml, if there is a board; and
    odometry.csv with odometry.yaml, if the camera stands on a robot.
    The folder appears when it is complete: an interrupted run leaves nothing there.

    Args:
        world: what there is to see, and the camera's path.
        imaging: how the pictures are taken.
        camera: that takes them; the path is the left one's.
        folder: to write; must not exist, or be empty.
        seed: of all that is random.
        on_frame: called after every image, in order.
        baseline_m: to a second camera like a `Pinhole`, to its right; a `RectifiedStereo` has its own.

    Raises:
        InputError: the folder exists, an option asks for frames that there are not, too few points can be known, or
            the baseline is not positive.

    Example:
        >>> import tempfile
        >>> from rbpf.validation.simulation.textured_desk import TexturedDesk
        >>> camera = Pinhole(80, 60, 50.0, 50.0, 39.5, 29.5)
        >>> folder = Path(tempfile.mkdtemp()) / "desk"
        >>> simulate_images(TexturedDesk(frames=2, texel_m=0.01), Imaging(), camera, folder, seed=0)
        >>> len(list((folder / "mav0" / "cam0" / "data").glob("*.png")))
        2
    """
    rng = np.random.default_rng(seed)
    scene = world.build(rng)
    imaging.check_frames(len(scene.stamps_ns))
    left, baseline_m = (
        (camera, baseline_m) if isinstance(camera, Pinhole) else (camera.camera, camera.baseline_m)
    )
    if baseline_m is not None and not baseline_m > 0.0:
        raise InputError(f"the stereo baseline must be positive, got {baseline_m!r} m")
    renderer = Renderer(scene.rectangles, left, imaging.grid)
    shutter = Shutter(scene, imaging, left, renderer, rng)
    with whole_folder(folder) as partial:
        _write_sensors(partial, scene, imaging, left, baseline_m)
        write_calibration(partial, left, baseline_m)
        write_truth(partial, scene.stamps_ns, scene.world_from_camera, shutter.velocities)
        if imaging.known:
            _write_known(partial, scene, imaging, left, renderer, rng)
        if scene.boards:
            _write_boards(partial, scene)
        if scene.odometry is not None:
            write_wheel_odometry(partial, scene.odometry)

        def take(frame: int) -> None:
            stamp = int(scene.stamps_ns[frame])
            for sensor, image in zip(("cam0", "cam1"), shutter.images(frame, baseline_m), strict=False):
                write_image(image_path(partial, sensor, stamp, imaging.suffix), image, imaging.jpeg)
            if imaging.depth:
                depth, _ = renderer.depth(scene.world_from_camera[frame])
                write_image(image_path(partial, "depth0", stamp), coded_depth(depth))

        _in_parallel(take, len(scene.stamps_ns), on_frame)


def _in_parallel(take: Callable[[int], None], frames: int, on_frame: OnFrame | None) -> None:
    """Takes all frames, several at a time; reports them in order."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pending = [pool.submit(take, frame) for frame in range(frames)]
        try:
            for done, future in enumerate(pending, start=1):
                future.result()
                if on_frame is not None:
                    on_frame(done, frames)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _write_sensors(
    folder: Path, scene: TexturedScene, imaging: Imaging, camera: Pinhole, baseline_m: float | None
) -> None:
    sensors = {"cam0": 0.0}
    if baseline_m is not None:
        sensors["cam1"] = baseline_m
    if imaging.depth:
        sensors["depth0"] = 0.0
    for sensor, offset_m in sensors.items():
        about = f"simulated {scene.name}, {sensor}"
        suffix = ".png" if sensor == "depth0" else imaging.suffix
        write_sensor(folder, sensor, camera, offset_m, scene.stamps_ns, about, suffix)


def _write_known(
    folder: Path,
    scene: TexturedScene,
    imaging: Imaging,
    camera: Pinhole,
    renderer: Renderer,
    rng: np.random.Generator,
) -> None:
    """known_points.csv."""
    known = known_corners(scene, renderer, camera, imaging.known)
    per_axis = 0.0 if imaging.known_exact else imaging.known_std_m / np.sqrt(3.0)
    error = per_axis * rng.standard_normal(known.positions.shape)
    lines = ["id,u_px,v_px,x_m,y_m,z_m,sigma_m"]
    for name, (px, position) in enumerate(zip(known.px, known.positions + error, strict=True), start=1):
        numbers = [f"{x:.4f}" for x in px] + [f"{x:.6f}" for x in position]
        lines.append(",".join([str(name), *numbers, f"{imaging.known_std_m:g}"]))
    (folder / "known_points.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_boards(folder: Path, scene: TexturedScene) -> None:
    """chessboard.yaml: one entry per board, poses as [qx, qy, qz, qw, x, y, z]."""
    import yaml

    boards = [
        {
            "columns": board.columns,
            "rows": board.rows,
            "square_m": board.square_m,
            "world_from_board": board.world_from_board.tolist(),
        }
        for board in scene.boards
    ]
    (folder / "chessboard.yaml").write_text(yaml.safe_dump(boards, sort_keys=False), encoding="utf-8")
