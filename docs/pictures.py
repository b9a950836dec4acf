"""Makes the README's pictures: `python docs/pictures.py`, from a desk that is rendered first.

docs/pictures/desk.webp   the annotated frames, as an animation
docs/pictures/map.png     the map at the end, with 3σ ellipses
"""

from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro
from PIL import Image

from rbpf.runs.folder import write_run
from rbpf.runs.plots import plot_map, save_figures
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import MonoRecording, filter_recording
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.report.video import annotated_frames
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images

EVERY = 4
"""Frames of the recording from one of the animation to the next."""

FRAMES, WIDTH, QUALITY = 45, 560, 45
"""Of the animation; its width in px, the quality in per cent."""

COLOURS = 64
"""Of the map's picture: lines and letters need no more."""


def animate(run: Run, path: Path) -> None:
    """Some of the annotated frames, smaller."""
    chosen = islice(annotated_frames(run), 1, 1 + EVERY * FRAMES, EVERY)
    pictures = [Image.fromarray(frame) for frame in chosen]
    size = WIDTH, round(WIDTH * pictures[0].height / pictures[0].width)
    small = [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    small[0].save(path, save_all=True, append_images=small[1:], duration=EVERY * 33, loop=0, quality=QUALITY, method=6)


def shrink(source: Path, path: Path) -> None:
    """A picture with few colours."""
    with Image.open(source) as picture:
        picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def main(images: Path | None = None, out: Path = Path(__file__).parent / "pictures") -> None:
    """Renders, filters, draws.

    Args:
        images: a sequence with its known_points.csv; by default a desk is rendered.
        out: folder for the pictures.
    """
    out.mkdir(exist_ok=True)
    with TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        if images is None:
            images = scratch / "desk"
            camera = Pinhole(640, 480, 512.0, 512.0, 319.5, 239.5)
            simulate_images(TexturedDesk(frames=300), Imaging(), camera, images, seed=0)
        run = filter_recording(MonoRecording(images, images / "known_points.csv"), MonoConfig())
        animate(run, out / "desk.webp")
        write_run(run, scratch / "run", {"recording": str(images)})
        save_figures({"map.png": plot_map(RunFolder.open(scratch / "run"))}, scratch)
        shrink(scratch / "map.png", out / "map.png")
    for path in (out / "desk.webp", out / "map.png"):
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    tyro.cli(main)
