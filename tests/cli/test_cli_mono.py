"""`rbpf run mono` from end to end, on a few small rendered frames."""

import importlib
import re
import sys

import cv2
import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.lie import SE3
from rbpf.runs.measurement_files import read_feature_log
from rbpf.runs.recordings import filter_features as filter_log
from rbpf.runs.trajectory import read_tum
from rbpf.sensors.readers import open_images
from rbpf.systems.mono.config import MonoConfig
from tests.cli.run_outputs import BATCH, FILES, OF_CAMERAS, REQUIRED, layout, names, outputs
from tests.cli.sequences import CAMERA, FRAMES, refused, run, sentence, summary
from tests.readers.images.bags import KINDS, film_images, recorded

pytestmark = pytest.mark.slow

WITHOUT_BATCH = FILES | {
    "known_map.npz", "tracking.png", "posterior.tum", "posterior.npz", "observations_frames.csv",
    "observations_known_points.csv",
}  # fmt: skip
OWN_ENTRIES = {
    "frames_tracked", "lost_frames", "relocalisations", "landmarks_full", "landmarks_partial", "observations_per_frame",
    "batch_frames", "batch_ate_rmse_m", "batch_ate_sim3_rmse_m", "filter_minus_batch_rmse_m",
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(desk, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "run"
    assert run(desk, out, "--video") == 0
    return out


def test_a_run_leaves_all_files_and_figures(finished):
    assert names(finished) == WITHOUT_BATCH | BATCH | {"annotated.mp4"}
    entries = summary(finished)
    assert entries.keys() >= REQUIRED | OF_CAMERAS | OWN_ENTRIES
    assert entries["frames"] == entries["frames_tracked"] == FRAMES
    assert entries["lost_frames"] == 0
    assert entries["ate_rmse_m"] < 0.01
    assert 10 <= entries["observations_per_frame"] <= 25
    assert "annotated.mp4" in (finished / "report.html").read_text()


def test_the_path_is_in_the_known_points_world(desk, finished):
    found = read_tum(finished / "trajectory.tum")
    truth = np.loadtxt(desk / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    assert np.linalg.norm(found.positions - truth[:, 1:4], axis=1).max() < 0.03


def test_the_map_is_in_that_world_and_flags_rays(desk, finished):
    with np.load(finished / "map.npz") as archive:
        mapped = dict(archive)
    entries = summary(finished)
    assert int(mapped["ray"].sum()) == entries["landmarks_partial"]
    assert int((1 - mapped["ray"]).sum()) == entries["landmarks_full"]
    known = np.loadtxt(desk / "known_points.csv", delimiter=",", skiprows=1)
    rows = mapped["known"] == 1
    assert rows.sum() == len(known)
    assert np.abs(mapped["mean"][rows] - known[:, 3:6]).max() < 0.01
    assert (np.linalg.eigvalsh(mapped["cov"]) > 0.0).all()
    rays = mapped["ray"] == 1
    largest = np.sqrt(np.linalg.eigvalsh(mapped["cov"]).max(axis=1))
    assert rays.any() and largest[rays].min() > largest[rows].max()


def test_the_measurements_are_those_that_the_filter_used(finished):
    """Filtered again without the images, they give the same path to the last bit."""
    log, config = read_feature_log(finished), MonoConfig(particles=8)
    again = filter_log(log, config).log
    told = read_tum(finished / "trajectory.tum")
    np.testing.assert_array_equal(again.stamps_ns, told.stamps_ns)
    np.testing.assert_allclose(again.poses, told.world_from_body, atol=1e-9)


def test_the_batch_optimum_of_them_lies_beside(finished):
    entries = summary(finished)
    assert len(read_tum(finished / "batch.tum")) == entries["batch_frames"] == FRAMES
    assert entries["batch_ate_sim3_rmse_m"] < 0.005
    assert "<td>batch</td>" in (finished / "report.html").read_text()


def test_the_posterior_over_paths(finished):
    with np.load(finished / "posterior.npz") as archive:
        paths, log_weights, stamps = (archive[n] for n in ("world_from_camera", "log_weights", "stamps_ns"))
    # Depths are not settled yet: the particles that begin.
    assert paths.shape == (FRAMES, 8, 7) and stamps.size == FRAMES
    assert np.exp(log_weights).sum() == pytest.approx(1.0)
    told, filtered = read_tum(finished / "posterior.tum"), read_tum(finished / "trajectory.tum")
    around = SE3.local(told.world_from_body[:, None], paths)
    np.testing.assert_allclose(np.einsum("n,tna->ta", np.exp(log_weights), around), 0.0, atol=1e-6)
    # At the end there is nothing later to learn from: only the frame's own sampling lies between the two.
    assert np.linalg.norm(told.positions[-1] - filtered.positions[-1]) < 0.005


def test_a_batch_that_takes_too_long_is_given_up_and_all_else_is_there(desk, tmp_path):
    assert run(desk, tmp_path, "--batch", "--batch-limit", "1") == 0
    assert "given up after 1 iterations" in summary(tmp_path)["batch_problem"]
    assert names(tmp_path) == WITHOUT_BATCH


def test_the_video_has_every_frame(finished):
    capture = cv2.VideoCapture(str(finished / "annotated.mp4"))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1])
    assert len(frames) == FRAMES
    assert frames[0].shape[1] == 2 * CAMERA.width
    green = (frames[8][..., 1].astype(int) - frames[8][..., 2] > 60).sum()
    assert green > 200


def test_it_starts_without_known_points(desk, tmp_path):
    assert run(desk, tmp_path, known=False) == 0
    entries = summary(tmp_path)
    assert entries["known_points"] == 0 and "path_rmse_m" not in entries
    first = read_tum(tmp_path / "trajectory.tum").world_from_body[0]
    assert np.allclose(first, [0, 0, 0, 1, 0, 0, 0], atol=1e-9)


def test_a_rerun_recording_is_written(desk, tmp_path):
    pytest.importorskip("rerun")
    recording = tmp_path / "run.rrd"
    assert run(desk, tmp_path / "run", "--rerun", str(recording)) == 0
    assert recording.stat().st_size > 20_000
    views, eye, target = layout(recording)
    assert views == {"path and map", "image", "effective sample size", "NIS per degree of freedom", "tracking"}
    # Seen from there, all of the path is in the picture.
    there = read_tum(tmp_path / "run" / "trajectory.tum").positions - eye
    cosines = there @ (target - eye) / np.linalg.norm(there, axis=1) / np.linalg.norm(target - eye)
    assert np.rad2deg(np.arccos(cosines)).max() < 35.0


def test_a_missing_rerun_is_said_before_the_run(desk, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert run(desk, tmp_path / "run", "--rerun", str(tmp_path / "run.rrd")) == 2
    assert "rerun-sdk" in sentence(capsys)
    assert not (tmp_path / "run").exists()


def test_the_program_starts_without_rerun_and_encoder(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    for name in ("finish", "report.video"):
        assert importlib.reload(importlib.import_module(f"rbpf.validation.{name}"))


class Player:
    """What cv2.VideoCapture shows of a camera: a folder's images, then it is unplugged."""

    def __init__(self, images):
        self.images = images
        self.given = iter(images)

    def isOpened(self):  # noqa: N802
        return True

    def set(self, *_):
        return True

    def read(self):
        image = next(self.given, None)
        return (False, None) if image is None else (True, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


def test_a_camera_is_filtered_until_it_is_gone(desk, tmp_path, monkeypatch):
    images = [frame.image for frame in open_images(desk).frames()]
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: Player(images))
    out = tmp_path / "run"
    command = ["run", "mono", "0", "--calibration", str(desk / "camera.yaml"), "--out", str(out), "--no-batch"]
    assert main(command) == 0
    assert np.loadtxt(out / "trajectory.tum").shape == (len(images), 8)
    assert yaml.safe_load((out / "config.yaml").read_text())["recording"] == "0"
    assert not (out / "annotated.mp4").exists()
    assert main(["run", "--from", str(out)]) == 2  # those images are gone


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "needs --calibration"),
        (["--calibration", "camera.yaml", "--resume"], "leave out --resume"),
        (["--calibration", "camera.yaml", "--known-points", "known_points.csv"], "--board or --aruco"),
        (["--calibration", "camera.yaml"], "there is no camera 0"),
    ],
)
def test_what_a_camera_cannot_do(options, words, desk, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    assert main(["run", "mono", "0", *options, "--out", str(tmp_path / "run")]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_run_is_shown_while_it_is_made(desk, tmp_path, monkeypatch):
    """The viewer's window is replaced by a file."""
    stream, shown = pytest.importorskip("rerun").RecordingStream, []
    log = stream.log
    monkeypatch.setattr(stream, "spawn", lambda stream: stream.save(str(tmp_path / "shown.rrd")))
    monkeypatch.setattr(stream, "log", lambda *given, **how: (shown.append(given[1]), log(*given, **how)))
    assert run(desk, tmp_path / "run", "--view") == 0
    assert shown.count("world/camera/image") == shown.count("plots/filter/ess") == FRAMES
    wanted = {"world/camera/image/found/ellipses", "world/path", "world/truth", "world/uncertainty"}
    assert wanted | {"world/map/points", "plots/filter/nis_per_dof", "plots/tracking/found"} <= set(shown)
    assert shown.count("world/map/points") > 1 and shown.count("world/truth") == 1


def test_a_viewer_that_cannot_be_opened_is_said(desk, tmp_path, monkeypatch, capsys):
    def refused(_stream):
        raise RuntimeError("no screen")

    monkeypatch.setattr(pytest.importorskip("rerun").RecordingStream, "spawn", refused)
    assert run(desk, tmp_path / "run", "--view") == 2
    assert "cannot be opened (no screen): leave out --view" in sentence(capsys)


def test_the_terminal_tells_of_tracking(desk, tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr("rich.progress.Progress.update", lambda _bars, _task, **given: said.append(given["words"]))
    assert run(desk, tmp_path / "run") == 0
    last = [words for words in said if words][-1]
    assert re.fullmatch(r"tracked, found \d+ of \d+, [\d.e+]+ frames per second", last)


# Bad images, calibrations and tables: one clear sentence where the run stops, a note where it goes on.


def survived(folder, out, *arguments):
    """The summary of a run that went on to the last frame."""
    assert run(folder, out, *arguments) == 0
    entries = summary(out)
    assert entries["frames"] == FRAMES
    return entries


def test_darkness_from_the_start_is_said_and_no_frame_of_it_counts_as_tracked(folder, tmp_path):
    for number in range(FRAMES):
        if number < 9:
            path = folder / "images" / f"{number:06d}.png"
            cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
    entries = survived(folder, tmp_path / "run")
    assert "shows nothing" in entries["problems"][0]
    assert 4 <= entries["frames_tracked"] <= FRAMES - 7
    assert entries["observations_per_frame"] > 2.0


def mixed_up(rows):
    return [[*row[:3], *rows[k - 1][3:]] for k, row in enumerate(rows)]


def in_line(rows):
    return [[*row[:3], str(0.1 * k), str(0.2 * k), "0.0", *row[6:]] for k, row in enumerate(rows)]


@pytest.mark.parametrize(("edit", "words"), [(mixed_up, "which point is which"), (in_line, "lie on a line")])
def test_known_points_that_cannot_be_are_refused(desk, folder, tmp_path, capsys, edit, words):
    header, *lines = (desk / "known_points.csv").read_text().splitlines()
    rows = edit([line.split(",") for line in lines])
    points = tmp_path / "points.csv"
    points.write_text("\n".join([header, *map(",".join, rows)]) + "\n")
    assert re.search(words, refused(capsys, folder, tmp_path / "run", "--known-points", points))


def test_results_cannot_replace_a_file(folder, tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    assert "is a file" in refused(capsys, folder, tmp_path / "taken")
    assert (tmp_path / "taken").read_text() == "mine"


# ROS bags: the same bytes as from the same images in a folder, and one sentence where that cannot be.


@pytest.fixture
def as_bag(desk, tmp_path):
    """The desk's images in a bag of a kind, with their truth."""

    def written(kind):
        with recorded(tmp_path / kind) as bag:
            film_images(bag, open_images(desk))
        # So that both recordings have one name, which several files repeat.
        return (tmp_path / kind).rename(tmp_path / ("desk.bag" if (tmp_path / kind).is_file() else "desk"))

    return written


def test_a_bag_gives_the_bytes_of_its_images_in_a_folder(desk, as_bag, tmp_path):
    known = ["--known-points", str(desk / "known_points.csv")]
    assert run(desk, tmp_path / "from_folder", "--video") == 0
    from_folder = outputs(tmp_path / "from_folder")
    assert run(as_bag(KINDS[1]), tmp_path / "run", *known, "--truth-topic", "/truth", "--video") == 0
    bag = outputs(tmp_path / "run")
    assert {name for name in from_folder | bag if from_folder.get(name) != bag.get(name)} == {"config.yaml"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_was_cut_off_is_refused(as_bag, tmp_path, capsys, kind):
    path = as_bag(kind)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    said = refused(capsys, path, tmp_path / "run")
    assert path.name in said and ("reindex" in said or "none of" in said)


def test_two_topics_are_not_one_camera_and_without_the_library_it_is_said_how_to_get_it(
    as_bag, tmp_path, capsys, monkeypatch
):
    path = as_bag(KINDS[0])
    said = refused(capsys, path, tmp_path / "run", "--image-topic", "/left,/right")
    assert "one camera has one topic of images" in said
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "pip install 'rbpf[bags]'" in refused(capsys, path, tmp_path / "run")
