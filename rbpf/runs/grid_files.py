"""An occupancy grid in files: grid.npz, and grid.pgm with grid.yaml as ROS's map_server and its successors read them.

grid.pgm has one byte per cell, the highest y in its first row: 0 where something is, 254 where beams have passed, 205 where
nothing is known. grid.yaml gives the side of a cell, the place of the lower left corner, and what the bytes mean.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rbpf.core.checkpoint import fitting, load_arrays, numbers, read
from rbpf.maps.grid import Picture
from rbpf.runs.files import GRID, whole, write_text

_ARRAYS = {"log_odds": numbers("rows", "columns"), "cell_m": numbers(), "corner": numbers(2)}
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205


def write_grid(out: Path, grid: Mapping[str, np.ndarray]) -> None:
    """Writes grid.pgm and grid.yaml of what grid.npz holds. Raises InputError: they cannot be written."""
    log_odds, (x, y) = grid["log_odds"], grid["corner"].tolist()
    cells = np.select([log_odds > 0.0, log_odds < 0.0], [_OCCUPIED, _FREE], _UNKNOWN).astype(np.uint8)
    height, width = cells.shape
    with whole(out / "grid.pgm") as temporary:
        temporary.write_bytes(f"P5\n{width} {height}\n255\n".encode() + cells[::-1].tobytes())
    words = {
        "image": "grid.pgm",
        "mode": "trinary",
        "resolution": f"{float(grid['cell_m']):g}",
        "origin": f"[{x:.6f}, {y:.6f}, 0.0]",
        "negate": "0",
        "occupied_thresh": "0.65",
        "free_thresh": "0.196",
    }
    write_text(out / "grid.yaml", "".join(f"{name}: {value}\n" for name, value in words.items()))


def read_grid(folder: Path) -> Picture:
    """The grid of a run. Raises InputError: grid.npz is missing or damaged."""
    arrays = load_arrays(folder / GRID)
    with fitting(folder / GRID):
        found = read(arrays, _ARRAYS)
        return Picture(found["log_odds"], float(found["cell_m"]), found["corner"])
