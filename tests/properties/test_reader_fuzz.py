"""Every reader of recordings and of results, on damaged files: what they read, or one InputError, and nothing else."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.measurement_files import read_feature_log, read_measurements, write_measurements
from rbpf.runs.trajectory import Trajectory, read_tum, write_tum
from rbpf.sensors.readers import Topics, open_images, open_log, open_stereo, read_known_points, text
from rbpf.sensors.readers.laser import read_laser_log
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from tests.properties.mutations import damaged, read_or_refused, restored
from tests.readers import small
from tests.readers.images import bags, folders
from tests.validation.worlds import world

pytestmark = pytest.mark.slow

POSES = SE3.exp(np.linspace(0.0, 1.0, 18).reshape(3, 6))

Read = Callable[[Path], object]


def frames(path: Path) -> object:
    """All images of a sequence, but no more than a few."""
    return list(islice(open_images(path).frames(), 8))


def seen(path: Path) -> object:
    """What a camera sees and where."""
    camera = open_images(path).camera
    seen_px = camera.project(np.array([[0.1, 0.2, 1.0], [3.0, 2.0, 1.0]]))
    return camera.unproject(seen_px), camera.field_of_view_mask(2.0)


def pairs(path: Path) -> object:
    return list(islice(open_stereo(path).frames(), 8))


def euroc(folder: Path) -> None:
    folders.write_euroc(folder)
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    folders.write_asl_truth(truth, POSES, folders.EUROC_NS, SE3.identity())


def fisheye(folder: Path) -> None:
    folders.write_plain(folder, model="fisheye", distortion=[-0.03, 0.02, -0.012, 0.002])


def fisheye_pair(folder: Path) -> None:
    lens = {"distortion_model": "equidistant", "distortion_coefficients": [-0.03, 0.02, -0.012, 0.002]}
    folders.write_rectified(folder, **lens)
    folders.write_asl_camera(folder / "mav0" / "cam0", folders.CAM0, **lens)


def kitti(folder: Path) -> None:
    folders.write_kitti(folder)
    (folder / "poses.txt").write_text("".join(folders.matrix_row(pose) for pose in POSES))


def plain(folder: Path) -> None:
    folders.write_plain(folder)
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")


def bag(name: str) -> tuple[Callable[[Path], object], Read, str]:
    """A bag with poses, and a pair; all of its files are damaged."""
    truth = Topics(truth="/truth")

    def write(folder: Path) -> None:
        bags.write_bag(folder / f"one_{name}")
        bags.write_pair(folder / f"two_{name}", image="image_raw")

    def read(folder: Path) -> None:
        problems = []
        for open_it in (
            lambda: open_images(folder / f"one_{name}", topics=truth),
            lambda: open_stereo(folder / f"two_{name}"),
        ):
            try:
                list(open_it().frames())
            except InputError as error:
                problems.append(error)
        if problems:
            raise problems[0]

    return write, read, "**/*.*"


def features(folder: Path) -> None:
    log = simulate_features(DeskWorld(frames=2), Measuring(measurements=8), MONO, seed=0)
    write_measurements(folder, replace(log, frames=[log.frames[0]] * 2))


RECORDINGS: dict[str, tuple[Callable[[Path], object], Read, str]] = {
    "folder": (plain, frames, "*"),
    "TUM": (folders.write_tum, frames, "*.txt"),
    "TUM camera": (folders.write_tum, frames, "camera.yaml"),
    "EuRoC": (euroc, frames, "**/*.[cy]*"),
    "EuRoC pair": (folders.write_rectified, pairs, "**/*.[cy]*"),
    "fisheye": (fisheye, seen, "camera.yaml"),
    "fisheye pair": (fisheye_pair, pairs, "**/sensor.yaml"),
    "KITTI": (kitti, frames, "*.txt"),
    "KITTI pair": (kitti, pairs, "calib.txt"),
    "ROS 1": bag("walk.bag"),
    "ROS 2, database": bag("walk_db3"),
    "ROS 2, MCAP": bag("walk_mcap"),
    "7-Scenes": (folders.write_seven_scenes, frames, "*.txt"),
    "MRCLAM": (lambda f: small.write(f, small.MRCLAM), open_log, "*.dat"),
    "MRPT": (lambda f: simulate_robot(RobotWorld(4, 5), f, 0), open_log, "*.*"),
    "Victoria Park": (lambda f: small.write(f, small.GRAPH), open_log, "graph.txt"),
    "CARMEN": (lambda f: small.write(f, small.CARMEN), lambda f: read_laser_log(f / "robot.clf"), "robot.clf"),
    "laser, ROS 1": (lambda f: bags.write_scans(f / "walk.bag"), lambda f: read_laser_log(f / "walk.bag"), "*"),
    "laser, ROS 2": (lambda f: bags.write_scans(f / "walk_db3"), lambda f: read_laser_log(f / "walk_db3"), "**/*.*"),
    "known points": (
        lambda f: small.write(f, small.KNOWN),
        lambda f: read_known_points(f / "known_points.csv"),
        "known_points.csv",
    ),
    "path": (
        lambda f: write_tum(f / "path.tum", Trajectory(np.arange(3) * 10**8, POSES)),
        lambda f: read_tum(f / "path.tum"),
        "path.tum",
    ),
    "features": (features, read_feature_log, "observations*.csv"),
    "measurements": (lambda f: write_measurements(f, world(2, "position")), read_measurements, "*.csv"),
}


@pytest.fixture(scope="module", params=sorted(RECORDINGS))
def recording(request, tmp_path_factory) -> tuple[Path, Read, list[Path]]:
    """A whole recording, its reader, and the files that are damaged."""
    write, read, pattern = RECORDINGS[request.param]
    folder = tmp_path_factory.mktemp("recording")
    write(folder)
    read(folder)
    files = sorted(path for path in folder.glob(pattern) if path.is_file())
    assert files
    return folder, read, files


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused(recording, data):
    folder, read, files = recording
    path = data.draw(st.sampled_from(files), "file")
    with restored(path) as whole:
        path.write_bytes(data.draw(damaged(whole), "content"))
        read_or_refused(lambda: read(folder))
    assert not (folder / "pwned").exists() and not Path("pwned").exists()


@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_a_damaged_video_is_read_or_refused(video, data):
    with restored(video) as whole:
        video.write_bytes(data.draw(damaged(whole)))
        read_or_refused(lambda: frames(video))


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """A short one."""
    return folders.write_video(tmp_path_factory.mktemp("video") / "clip.avi", count=4)


def test_a_video_that_claims_more_images_than_it_has_bytes_is_counted(video):
    """The AVI header has the number of images at a fixed place."""
    whole = video.read_bytes()
    place = whole.index(b"avih") + 8 + 16
    claimed = whole[:place] + (2**31 - 1).to_bytes(4, "little") + whole[place + 4 :]
    lengths = whole.index(b"strh") + 8 + 32
    claimed = claimed[:lengths] + (2**31 - 1).to_bytes(4, "little") + claimed[lengths + 4 :]
    liar = video.with_name("liar.avi")
    liar.write_bytes(claimed)
    assert len(open_images(liar)) == 4


def test_a_table_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    small.write(tmp_path, small.KNOWN)
    monkeypatch.setattr(text, "MOST_BYTES", 20)
    with pytest.raises(InputError, match="larger than"):
        read_known_points(tmp_path / "known_points.csv")
