"""Maps and paths as PLY files (G. Turk, 1994), binary little-endian: for MeshLab, CloudCompare, Blender."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.runs.files import whole

_VERTEX = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
_SIGMA = [("sigma_m", "<f4")]
_EDGE = [("vertex1", "<i4"), ("vertex2", "<i4")]
_NAMES = {"<f4": "float", "u1": "uchar", "<i4": "int"}


def write_ply(
    path: Path,
    points: Array,
    colours: NDArray[np.uint8],
    sigmas: Array | None = None,
    edges: NDArray[np.int64] | None = None,
) -> None:
    """Writes points, and lines between them; the file appears under its name when complete.

    Args:
        path: the file.
        points: (M, 3) [m].
        colours: (M, 3) RGB.
        sigmas: (M,) a further property sigma_m of each point.
        edges: (L, 2) rows of the points that a line connects.

    Raises:
        InputError: a coordinate is not finite.
    """
    if not np.isfinite(points).all():
        raise InputError(f"{path}: expected finite coordinates, found others in row {_first_bad(points)}.")
    vertices = np.empty(len(points), dtype=_VERTEX + (_SIGMA if sigmas is not None else []))
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    if sigmas is not None:
        vertices["sigma_m"] = sigmas
    lines = np.empty(0 if edges is None else len(edges), dtype=_EDGE)
    if edges is not None:
        lines["vertex1"], lines["vertex2"] = edges.T
    with whole(path) as partial:
        partial.write_bytes(_header(vertices, lines) + vertices.tobytes() + lines.tobytes())


def read_ply(path: Path) -> dict[str, np.ndarray]:
    """Elements by name as structured arrays, of a file that `write_ply` wrote.

    Raises:
        InputError: the file is missing or of another form.
    """
    try:
        head, _, body = path.read_bytes().partition(b"end_header\n")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    lines = head.decode("ascii", "replace").splitlines()
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise InputError(f"{path}: expected a binary little-endian PLY file.")
    try:
        return _elements(lines[2:], body)
    except (LookupError, ValueError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path}: expected the elements of a PLY file as its header says, found others."
        ) from error


def _elements(lines: list[str], body: bytes) -> dict[str, np.ndarray]:
    """Of the lines of a header and of what follows it; nothing is allocated that the file does not hold."""
    codes = {name: code for code, name in _NAMES.items()}
    kinds: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for line in lines:
        word, *rest = line.split()
        if word == "element":
            kinds[rest[0]] = (int(rest[1]), [])
        elif word == "property":
            list(kinds.values())[-1][1].append((rest[1], codes[rest[0]]))
    found, start = {}, 0
    for name, (count, fields) in kinds.items():
        if count < 0:
            raise ValueError("a negative number of elements")
        found[name] = np.frombuffer(body, dtype=fields, count=count, offset=start)
        start += found[name].nbytes
    return found


def _header(vertices: np.ndarray, lines: np.ndarray) -> bytes:
    rows = ["ply", "format binary_little_endian 1.0"]
    for name, elements in (("vertex", vertices), ("edge", lines)):
        if name == "edge" and not len(elements):
            continue
        rows.append(f"element {name} {len(elements)}")
        rows += [f"property {_NAMES[code]} {field}" for field, code in _fields(elements)]
    return "\n".join([*rows, "end_header", ""]).encode("ascii")


def _fields(elements: np.ndarray) -> list[tuple[str, str]]:
    names = elements.dtype.names or ()
    return [(name, elements.dtype[name].str.replace("|", "")) for name in names]


def _first_bad(points: Array) -> int:
    return int(np.argmin(np.isfinite(points).all(axis=1)))
