"""Stereo SLAM of a robot in a laboratory, compared with its own visual odometry.

A short part of the tour is rendered, subsampled as the robot is slow, and filtered with 400 particles (S05). The plot
shows the map and the path from above; the table compares the errors of SLAM and of the same run's odometry.
`reproduce_s05.py` covers the whole tour.
"""

import shutil
from pathlib import Path

import tyro

from examples.studies.lab import LabDrive, TexturedLab
from rbpf.runs.files import write_table
from rbpf.runs.recordings import StereoRecording, filter_recording
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.finish import finish_run
from rbpf.validation.simulation.images import Imaging, simulate_images

FIGURES = ("ate_rmse_m", "vo_ate_rmse_m", "landmarks_mean_per_particle", "updates", "distance_m", "lost_frames")


def render(folder: Path, frames: int, width: int) -> Path:
    """Renders the first pairs of the tour, unless they exist already."""
    if not folder.exists():
        height, focal = 3 * width // 4, 0.78125 * width
        camera = Pinhole(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
        world = TexturedLab(LabDrive("tour", frames=frames, every=4), texel_m=1.92 / width)
        simulate_images(world, Imaging(known=0, noise_std=4.0), RectifiedStereo(camera, 0.12), folder, seed=0)
    return folder


def main(
    frames: int = 240, particles: int = 50, out: Path = Path("demo/stereo_lab"), quick: bool = False
) -> dict[str, float]:
    """Renders and filters the tour, and prints the main figures.

    Args:
        frames: number of image pairs.
        particles: number of particles.
        out: folder for images, run, table and plot.
        quick: few small pairs and few particles.
    """
    frames, particles, width = (12, 20, 320) if quick else (frames, particles, 640)
    recording = StereoRecording(render(out / "lab", frames, width))
    run = filter_recording(recording, StereoConfig(particles=particles), out / "run")
    entries = finish_run(run, out / "run", recording.sources())
    figures = {name: float(entries[name]) for name in FIGURES if entries.get(name) is not None}
    for name, value in figures.items():
        print(f"{name:>28} {value:.4g}")
    write_table(out / "figures.csv", ["figure", "value"], [[name, value] for name, value in figures.items()])
    shutil.copy(out / "run" / "map.png", out / "map.png")
    print(f"pictures and the report are in {out / 'run'}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
