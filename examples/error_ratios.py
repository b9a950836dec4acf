"""How far is the filter from the best that its measurements allow? A table of filter and batch errors.

Each recording is filtered with several seeds; GTSAM adjusts the very measurements that each run used. A ratio of 1 is
perfect, up to 1.5 is the goal. Where recordings lie is told by the environment variable RBPF_DATA; those that are not
there are passed over. A simulated log and a rendered desk are always in the table.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from rbpf.runs.plots import COLOURS, new_axes, save_figures
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import stereo_tracks
from rbpf.systems.mono.config import MonoConfig, SearchConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.error_ratios import (
    HEADER,
    ErrorRatio,
    camera_ratio,
    robot_ratio,
    stereo_ratio,
    tracks_ratio,
)
from rbpf.validation.mono import Recording
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from rbpf.validation.simulation.textured_desk import TexturedDesk
from rbpf.validation.stereo import StereoRecording
from rbpf.validation.tables import write_table

ROBOTS = "mrpt_kf_slam_2d", "mrpt_kf_slam_6d", "mrclam6_robot1"
CAMERAS = "mono_redkitchen_a", "stereo_zed_room1"
PAIRS = "stereo_zed_room1", "stereo_kitti_seq1"
TRACKS = "gtsam_stereo_vo"
RENDERED_PX = 0.25
"""Noise of a match in rendered images, nearly: told one pixel the filter weighs its measurements too little."""


def main(quick: bool = False, out: Path = Path("out"), seeds: int = 5) -> dict[str, float]:
    """Prints the table, and writes it and its picture to a folder; `quick` takes the simulated worlds, made small."""
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        found = list(simulated(Path(folder), quick, 1 if quick else seeds))
    if not quick:
        found += recorded(Path(os.environ.get("RBPF_DATA", "../shared/data")), seeds)
    write_table(out / "error_ratios.csv", HEADER, [ratio.row() for ratio in found])
    save_figures({"error_ratios.png": picture(found)}, out)
    return {ratio.recording: ratio.ratio for ratio in found}


def simulated(folder: Path, quick: bool, seeds: int) -> Iterator[ErrorRatio]:
    """A robot's log and a rendered desk, of which everything is known."""
    simulate_robot(RobotWorld(steps=60 if quick else 200, landmarks=25), folder / "simulated_robot", seed=0)
    yield robot_ratio(folder / "simulated_robot", RangeBearingConfig(), range(seeds))
    width, frames = (320, 30) if quick else (640, 300)
    camera = Pinhole(width, 3 * width // 4, 0.8 * width, 0.8 * width, width / 2 - 0.5, 3 * width / 8 - 0.5)
    desk = folder / "rendered_desk"
    simulate_images(TexturedDesk(frames=frames), Imaging(known=6), camera, desk, seed=0)
    told = MonoConfig(search=SearchConfig(noise_px=RENDERED_PX))
    yield camera_ratio(Recording(desk, desk / "known_points.csv"), told, range(seeds))


def recorded(data: Path, seeds: int) -> Iterator[ErrorRatio]:
    """The recordings that are there."""
    for name in ROBOTS:
        if (data / name).is_dir():
            yield robot_ratio(data / name, RangeBearingConfig(), range(seeds))
    for name in PAIRS:
        if (data / name).is_dir():
            yield stereo_ratio(StereoRecording(data / name), StereoConfig(), range(seeds))
    if (data / TRACKS).is_dir():
        tracks = stereo_tracks.read(data / TRACKS)
        yield tracks_ratio(tracks.log, StereoConfig(), range(seeds), tracks.world_from_camera)
    for name in CAMERAS:
        if (data / name).is_dir():
            yield camera_ratio(
                Recording(data / name, data / name / "known_points.csv"), MonoConfig(), range(seeds)
            )


def picture(found: list[ErrorRatio]):
    """Filter and batch side by side, on a logarithmic scale."""
    figure, axes = new_axes("filter beside the batch optimum", "position error [m]", "", equal=False)
    places = range(len(found))
    names = {"filter": [ratio.row()[3] for ratio in found], "batch": [ratio.row()[6] for ratio in found]}
    for shift, (name, errors) in zip((-0.2, 0.2), names.items(), strict=True):
        axes.bar([place + shift for place in places], errors, 0.38, color=COLOURS[name], label=name)
    axes.set_yscale("log")
    axes.set_xticks(list(places), [ratio.recording for ratio in found], rotation=20, ha="right")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
