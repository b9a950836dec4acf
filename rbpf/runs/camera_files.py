"""Measurements of a camera in files: what a run over images leaves behind for the comparison with a batch optimiser.

Text files in the run's folder, numbers with every digit (reading gives back the same bits):

observations.csv

    # rbpf observations 1
    # recording: NAME
    # space: SE3
    # measurement: pinhole
    # size: width and height of the images, px
    # lens: equidistant, where it is a fisheye lens; else this line is left out
    # camera: fx, fy, cx, cy, k1, k2, p1, p2, k3, or four numbers of an equidistant lens
    # rows: how many lines follow the columns' names
    step,stamp_ns,landmark,u_px,v_px,c00,c10,c11

one line per measurement, in the order of the frames, its covariance [px^2] as the lower triangle by rows; of a
rectified stereo pair

    # measurement: stereo
    # baseline: between the cameras, m
    step,stamp_ns,landmark,u_left_px,v_px,u_right_px,c00,c10,c11,c20,c21,c22

observations_frames.csv

    # rbpf frames 1
    # recording: NAME
    # rows: how many lines follow the columns' names
    step,stamp_ns

one line per frame, with measurements or without; and, where there were known points,

observations_known_points.csv

    # rbpf known points 1
    # recording: NAME
    # rows: how many lines follow the columns' names
    landmark,x_m,y_m,z_m,c00,c10,c11,c20,c21,c22

one line per point, with the lower triangle of its covariance [m^2].
"""

from pathlib import Path

import numpy as np

from rbpf import gaussian
from rbpf.runs.files import write_text
from rbpf.runs.headed_table import HeadedTable
from rbpf.sensors.features import FeatureFrame, FeatureLog, KnownPoints
from rbpf.sensors.pinhole import LENSES, Pinhole, RectifiedStereo
from rbpf.sensors.readers.text import quoted

OBSERVATIONS = "observations.csv"
FRAMES = "observations_frames.csv"
KNOWN = "observations_known_points.csv"

TITLES = {OBSERVATIONS: "rbpf observations 1", FRAMES: "rbpf frames 1", KNOWN: "rbpf known points 1"}
_HINT = "a file that every run over images writes into its folder"
_COLUMNS = {
    FRAMES: ("step", "stamp_ns"),
    KNOWN: ("landmark", "x_m", "y_m", "z_m", "c00", "c10", "c11", "c20", "c21", "c22"),
}
_MEASURED = {
    "pinhole": ("u_px", "v_px", "c00", "c10", "c11"),
    "stereo": ("u_left_px", "v_px", "u_right_px", "c00", "c10", "c11", "c20", "c21", "c22"),
}
PLAIN = "radial-tangential"
"""The lens that is meant where none is named."""
CAMERAS = tuple(_MEASURED)
"""What a camera's measurements are called in the file's header."""


def write_features(folder: Path, log: FeatureLog) -> None:
    """Writes the files of a log of one camera or a rectified pair; those of a former run are replaced."""
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    steps = np.repeat(np.arange(stamps.size), [frame.landmarks.size for frame in log.frames])
    names, z, cov = (
        np.concatenate([getattr(f, part) for f in log.frames]) for part in ("landmarks", "z", "cov_z")
    )
    header = _header(log.camera)
    columns = _columns(header["measurement"])
    numbers = np.concatenate([z, gaussian.pack(cov)], axis=1)
    rows = np.stack([steps, stamps[steps], names], axis=1)
    _write(folder, OBSERVATIONS, columns, log.name, header, rows, numbers)
    rows = np.stack([np.arange(stamps.size), stamps], axis=1)
    _write(folder, FRAMES, _COLUMNS[FRAMES], log.name, {}, rows, np.empty((stamps.size, 0)))
    (folder / KNOWN).unlink(missing_ok=True)
    if log.known is not None:
        numbers = np.concatenate([log.known.positions, gaussian.pack(log.known.cov)], axis=1)
        _write(folder, KNOWN, _COLUMNS[KNOWN], log.name, {}, log.known.names[:, None], numbers)


def read_features(folder: Path) -> FeatureLog:
    """Reads what `write_features` wrote; the log has no truth.

    Raises:
        InputError: names the file and the line that is not as expected.
    """
    seen = HeadedTable.read(folder / OBSERVATIONS, TITLES[OBSERVATIONS], _HINT)
    seen.choice("space", ("SE3",))
    measurement = seen.choice("measurement", CAMERAS)
    stamps = _read_frames(folder, seen.text("recording"))
    integers, numbers = seen.body(_columns(measurement), 3)
    steps = integers[:, 0]
    seen.require(
        (steps >= 0) & (steps < stamps.size), f"a step from 0 to {stamps.size - 1}, the last in {FRAMES}"
    )
    seen.require(integers[:, 1] == stamps[steps], f"the stamp that {FRAMES} gives this step")
    seen.require(np.diff(steps, prepend=0) >= 0, "steps in order")
    cuts = np.searchsorted(steps, np.arange(1, stamps.size))
    camera = _read_camera(seen, measurement)
    p = camera.dim
    columns = (integers[:, 2], numbers[:, :p], gaussian.unpack(numbers[:, p:], p))
    parts = zip(stamps.tolist(), *(np.split(column, cuts) for column in columns), strict=True)
    frames = [FeatureFrame(*part) for part in parts]
    return FeatureLog(seen.text("recording"), camera, frames, _read_known(folder))


def _columns(measurement: str) -> tuple[str, ...]:
    return ("step", "stamp_ns", "landmark", *_MEASURED[measurement])


def _header(camera: Pinhole | RectifiedStereo) -> dict[str, str]:
    if isinstance(camera, RectifiedStereo):
        header = _header(camera.camera) | {"measurement": "stereo"}
        return header | {"baseline": repr(float(camera.baseline_m))}
    lens = {} if camera.distortion_model == PLAIN else {"lens": camera.distortion_model}
    return {
        "space": "SE3",
        "measurement": "pinhole",
        "size": f"{camera.width} {camera.height}",
        **lens,
        "camera": " ".join(repr(float(x)) for x in _intrinsics(camera)),
    }


def _intrinsics(camera: Pinhole) -> tuple[float, ...]:
    return (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)


def _write(
    folder: Path,
    name: str,
    columns: tuple[str, ...],
    recording: str,
    header: dict[str, str],
    integers: np.ndarray,
    numbers: np.ndarray,
) -> None:
    lines = [f"# {TITLES[name]}", f"# recording: {recording}"]
    lines += [f"# {key}: {value}" for key, value in header.items()]
    lines += [f"# rows: {len(integers)}", ",".join(columns)]
    rows = zip(integers.tolist(), numbers.tolist(), strict=True)
    lines += [",".join(map(repr, [*whole, *real])) for whole, real in rows]
    write_text(folder / name, "\n".join([*lines, ""]))


def _read_frames(folder: Path, recording: str) -> np.ndarray:
    table = HeadedTable.read(folder / FRAMES, TITLES[FRAMES], _HINT)
    if table.text("recording") != recording:
        problem = (
            f"expected recording {recording} as in {OBSERVATIONS}, found {quoted(table.text('recording'))}"
        )
        raise table.header_error("recording", f"{problem}; take both files from one run")
    integers, _ = table.body(_COLUMNS[FRAMES], 2)
    table.require(integers[:, 0] == np.arange(len(integers)), "one row per frame, from step 0 in order")
    table.require(np.diff(integers[:, 1], prepend=integers[:1, 1]) >= 0, "stamps in order of time")
    return np.ascontiguousarray(integers[:, 1])


def _read_camera(table: HeadedTable, measurement: str) -> Pinhole | RectifiedStereo:
    width, height = table.numbers("size", 2).tolist()
    lens = table.choice("lens", tuple(LENSES)) if "lens" in table.header else PLAIN
    numbers = table.numbers("camera", 4 + len(LENSES[lens].names)).tolist()
    fx, fy, cx, cy, *distortion = numbers
    camera = Pinhole(int(width), int(height), fx, fy, cx, cy, tuple(distortion), lens)
    return (
        RectifiedStereo(camera, float(table.numbers("baseline", 1)[0])) if measurement == "stereo" else camera
    )


def _read_known(folder: Path) -> KnownPoints | None:
    if not (folder / KNOWN).exists():
        return None
    table = HeadedTable.read(folder / KNOWN, TITLES[KNOWN], _HINT)
    integers, numbers = table.body(_COLUMNS[KNOWN], 1)
    return KnownPoints(integers[:, 0].copy(), numbers[:, :3].copy(), gaussian.unpack(numbers[:, 3:], 3))
