"""Camera calibration from images of a chessboard: camera.yaml, figures, and a plot of corners and residuals.

camera.yaml        the camera, as `rbpf.sensors.readers.images.calibration` reads it
calibration.json   reprojection error, standard deviations, which images were used
calibration.png    detected corners, and reprojection residuals
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.files import OnDone, prepare_folder, write_text
from rbpf.runs.plots import COLOURS, blank, label, save_figures
from rbpf.sensors.calibration import Board, BoardCalibration, BoardView, board_corners, calibrate
from rbpf.sensors.readers.images.calibration import MODELS, NAME, camera_text, model_of
from rbpf.sensors.readers.images.video import read_uncalibrated

FIGURES, PICTURE = "calibration.json", "calibration.png"
#: Maximum images searched, and views used; more only take longer.
MOST_SHOTS, MOST_VIEWS = 150, 40
_INTRINSICS = "fx", "fy", "cx", "cy"


def calibrate_images(
    images: Path, board: Board, on_image: OnDone | None = None, model: str = "pinhole"
) -> tuple[BoardCalibration, int]:
    """Calibrates a pinhole or fisheye camera from a folder or video of a board; also returns the number of images searched.

    `on_image` is called with the images searched and their number. Raises InputError: no or too few images show the
    board, they differ in size, or do not determine the camera.
    """
    total, shots = read_uncalibrated(images, MOST_SHOTS)
    views, size, looked_at, empty = list[BoardView](), (0, 0), 0, None
    for looked_at, (name, image) in enumerate(shots, 1):
        found = image.shape[1], image.shape[0]
        if looked_at == 1:
            size = found
        elif found != size:
            raise InputError(
                f"{images}: {name} has {found[0]}x{found[1]} px, the images before it {size[0]}x{size[1]}: "
                "calibrate with images of one camera in one setting, all upright or all on their side"
            )
        px = board_corners(image, board, thorough=not views)
        if px is not None:
            views.append(BoardView(name, px))
        elif empty is None:
            empty = image
        if on_image is not None:
            on_image(looked_at, total)
    if not views:
        if empty is None:
            raise InputError(f"{images}: none of its images can be read")
        # Squares are often counted in place of corners.
        places = "--board counts the places where four squares meet"
        for columns, rows in ((board.columns + less, board.rows + less) for less in (-1, 1)):
            if min(columns, rows) >= 3 and board_corners(empty, Board(columns, rows, board.square_m)) is not None:
                raise InputError(
                    f"{images}: a chessboard of {columns}x{rows} corners is seen: {places}, give --board {columns}x{rows}"
                )
        raise InputError(
            f"{images}: no chessboard of {board.columns}x{board.rows} inner corners is found in {looked_at} images: it has to "
            f"be seen whole, with its white border, sharp and evenly lit; {places}"
        )
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().astype(int))
    return calibrate([views[row] for row in chosen], board, *size, MODELS[model]), looked_at


def write_calibration(found: BoardCalibration, board: Board, looked_at: int, out: Path) -> dict[str, Any]:
    """Writes the three files; returns the entries of calibration.json."""
    prepare_folder(out)
    names = (*_INTRINSICS, *found.camera.lens.coefficient_names)
    entries = {
        "board": f"{board.columns}x{board.rows}",
        "square_m": board.square_m,
        "images": looked_at,
        "views": len(found.views),
        "views_left_out": list(found.left_out),
        "width": found.camera.width,
        "height": found.camera.height,
        "model": model_of(found.camera),
        **dict(zip(names, found.camera.params[: len(names)].tolist(), strict=True)),
        "std": dict(zip(names, found.std.tolist(), strict=True)),
        "reprojection_rms_px": found.rms_px,
        "worst_view_rms_px": float(found.rms_by_view_px.max()),
        "image_covered": found.covered,
    }
    save_figures({PICTURE: _draw(found)}, out)
    write_text(out / FIGURES, json.dumps(entries, indent=2, allow_nan=False) + "\n")
    about = f"from {len(found.views)} views of a chessboard; reprojection error {found.rms_px:.3f} px"
    write_text(out / NAME, camera_text(found.camera, about))
    return entries


def _draw(found: BoardCalibration) -> Any:
    """Corners with residuals, enlarged; the residuals; the error of each view."""
    figure = blank(13.0, 8.0)
    axes: Any = figure.subplot_mosaic([["image", "residuals"], ["image", "views"]], width_ratios=[1.7, 1.0])
    image = axes["image"]
    px, residuals = np.concatenate([view.px for view in found.views]), found.residuals.reshape(-1, 2)
    enlarged = 0.02 * found.camera.width / max(found.rms_px, np.finfo(float).eps)
    error = f"{len(found.views)} views, reprojection error {found.rms_px:.3f} px"
    label(image, f"{error}; residuals {enlarged:.0f} times enlarged", "u [px]", "v [px]", equal=False)
    image.set_aspect("equal")
    image.plot(*px.T, ".", markersize=3, color=COLOURS["truth"])
    image.quiver(
        *px.T, *(enlarged * residuals).T, angles="xy", scale_units="xy", scale=1.0, width=0.001, color=COLOURS["map"]
    )
    image.set(xlim=(-0.5, found.camera.width - 0.5), ylim=(found.camera.height - 0.5, -0.5))
    image.plot(found.camera.cx, found.camera.cy, "+", markersize=14, color=COLOURS["known"])
    label(axes["residuals"], "residuals of all corners", "u [px]", "v [px]", equal=True)
    axes["residuals"].plot(*residuals.T, ".", markersize=2, color=COLOURS["filter"])
    label(axes["views"], "error of each view", "view", "root mean square [px]", equal=False)
    axes["views"].bar(np.arange(len(found.views)), found.rms_by_view_px, color=COLOURS["filter"])
    axes["views"].axhline(found.rms_px, color=COLOURS["batch"])
    return figure
