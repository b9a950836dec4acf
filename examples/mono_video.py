"""Monocular SLAM on any image sequence, in ten lines; by default on a rendered desk.

Results are in the run's folder: the path, the map with its covariances, plots, and the video with the features searched
in every frame.
"""

from pathlib import Path

import tyro

from rbpf.runs.recordings import MonoRecording, filter_opened, open_mono
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.finish import finish_run
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images


def slam(images: Path, known_points: Path | None, particles: int, out: Path) -> dict[str, float]:
    """The ten lines."""
    sequence = open_images(images)
    known = None if known_points is None else read_known_points(known_points)
    run = filter_opened(open_mono(sequence, MonoConfig(particles=particles), known))
    print(f"the camera ended at {run.log.poses[-1, 4:].round(3)} m, lost in {int(run.log.lost().sum())} frames")
    return finish_run(run, out, MonoRecording(images, known_points).sources())


def render(folder: Path, frames: int, width: int) -> Path:
    """Renders a desk, unless it exists already."""
    camera = Pinhole(width, 3 * width // 4, 0.8 * width, 0.8 * width, 0.5 * width - 0.5, 0.375 * width - 0.5)
    if not folder.exists():
        simulate_images(TexturedDesk(frames=frames), Imaging(), camera, folder, seed=0)
    return folder


def main(
    images: Path | None = None,
    known_points: Path | None = None,
    out: Path = Path("demo/mono_video"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs monocular SLAM and prints the main figures.

    Args:
        images: a folder of images or a video, with its camera.yaml; by default a desk is rendered.
        known_points: table of known points.
        out: folder for the results.
        quick: few small frames and few particles.
    """
    if images is None:
        images = render(out / "desk", 20 if quick else 300, 320 if quick else 640)
        known_points = images / "known_points.csv"
    entries = slam(images, known_points, 20 if quick else 50, out)
    names = ("frames_tracked", "observations_per_frame", "landmarks_full", "ate_rmse_m")
    figures = {name: float(entries[name]) for name in names if name in entries}
    for name, value in figures.items():
        print(f"{name:>24} {value:.4g}")
    print(f"results, pictures and the annotated video in {out}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
