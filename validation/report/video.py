"""Annotated video of a run over images, with the searched and matched features of each frame.

A new system needs a function from a run and a frame's number to a picture, entered into `PICTURES`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

import numpy as np

from rbpf.core.checkpoint import whole
from rbpf.runs.files import OnDone
from rbpf.runs.plots import outline
from rbpf.runs.run import Run
from rbpf.sensors.readers import ImageFrame
from rbpf.systems.stereo.landmarks import FeatureKind

Colour = tuple[int, int, int]
Place = Callable[[np.ndarray], list[tuple[float, float]]]  #: Pixels (…, 2) of the image to points of the picture.
FOUND, MISSED, STARTED, TEXT = (60, 220, 60), (240, 60, 50), (90, 170, 255), (255, 255, 255)
_SMALL_PX = 800  #: Narrower images are drawn at twice their size, as an ellipse of three pixels would be invisible.
_ARM, _BAND = 4, 24
#: Height of letters as a fraction of the drawn width, and its bounds, px.
_LETTER_FRACTION, _SMALLEST, _LARGEST = 1.0 / 62.0, 11.0, 17.0


def drawn_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of a drawn frame, even numbers, as video needs them."""
    scale = drawn_scale(width)
    return scale * width + (scale * width) % 2, scale * height + _BAND + (scale * height + _BAND) % 2


def drawn_scale(width: int) -> int:
    """Magnification of an image of this width."""
    return 2 if width < _SMALL_PX else 1


def annotate(
    image: np.ndarray | None,
    size: tuple[int, int],
    caption: tuple[str, str],
    legend: Sequence[tuple[str, Colour]],
    paint: Callable[[Any, Place], None],
) -> np.ndarray:
    """The frame (H, W, 3) uint8 as shown, under a caption (figures, warning) and a legend of names and colours.

    The image is (height, width) uint8 of a size (width, height), or None if it could not be read. `paint` is called with
    PIL's drawing of the picture, and with the function from pixels to its points.
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
    """The frame (H, W, 3) uint8 of a size (width, height), with the searched features, see `MonoSlam.observed`."""
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
    """A line (2, 2) clipped to one image size around the image: far ends may project anywhere."""
    start, step = line[0], line[1] - line[0]
    low, high = -np.asarray(size, dtype=float), 2.0 * np.asarray(size, dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(low - start) / step, (high - start) / step]), axis=0)
    enter = max(0.0, float(np.nanmax(np.where(step == 0.0, 0.0, ends[0]))))
    leave = min(1.0, float(np.nanmin(np.where(step == 0.0, 1.0, ends[1]))))
    return start + np.array([[enter], [max(enter, leave)]]) * step


#: Names and colours of the roles of a pair's features, in drawing order.
FEATURES: Mapping[FeatureKind, tuple[str, Colour]] = {
    FeatureKind.FEATURE: ("feature", (150, 150, 150)),
    FeatureKind.CANDIDATE: ("candidate", (255, 190, 40)),
    FeatureKind.LANDMARK: ("landmark", FOUND),
    FeatureKind.NEW: ("new", STARTED),
}


def picture_of_pair(run: Run, t: int, frame: ImageFrame) -> np.ndarray:
    """A frame of a stereo run (H, W, 3): the left image, with the role of each feature in the map.

    A line from each shows its position in the right image.
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
    """Generates the frames of a run (H, W, 3) uint8; its source is read again."""
    draw = PICTURES[run.system.name]
    for t, frame in zip(range(len(run.log)), run.source.frames(), strict=False):
        yield draw(run, t, frame)


#: Bounds of the time per image, for sequences without useful stamps: photos, equal stamps.
SHORTEST_S, LONGEST_S = 1.0 / 120.0, 1.0
#: H.264 of constant quality: a rate factor of 18 is nearly lossless, 28 poor; equal frames give equal bytes.
ENCODING = "-an -vcodec libx264 -pix_fmt yuv420p -crf 23 -preset veryfast -fflags +bitexact -flags:v +bitexact"


def write_video(
    pictures: Iterator[np.ndarray], stamps_ns: np.ndarray, path: Path, on_frame: OnDone | None = None
) -> None:
    """Writes an MP4 of frames (H, W, 3) uint8, at least one, of one even size, at the rate of their stamps (T,).

    It appears under its name once it is complete. `on_frame` is called with the number of frames written and the total.
    Raises InputError: the file cannot be written.
    """
    import imageio_ffmpeg

    first = next(pictures)
    raw = f"-y -v error -f rawvideo -pix_fmt rgb24 -s {first.shape[1]}x{first.shape[0]} -r {frame_rate(stamps_ns)} -i -"
    with whole(path) as partial:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), *f"{raw} {ENCODING}".split(), str(partial.absolute())]
        # In a separate process session, so that Ctrl-C reaches only this program, which ends it.
        with Popen(command, stdin=PIPE, start_new_session=True) as encoder:
            assert encoder.stdin is not None
            for t, picture in enumerate(chain([first], pictures)):
                encoder.stdin.write(picture.tobytes())
                if on_frame is not None:
                    on_frame(t + 1, stamps_ns.size)
        if encoder.returncode:
            raise OSError("the encoder could not finish, the disk may be full")


def frame_rate(stamps_ns: np.ndarray) -> float:
    """Images per second of a video at the recording's speed."""
    gaps = np.diff(stamps_ns) * 1e-9
    gaps = gaps[gaps > 0.0]
    typical = float(np.median(gaps)) if gaps.size else LONGEST_S
    return round(1.0 / min(max(typical, SHORTEST_S), LONGEST_S), 3)
