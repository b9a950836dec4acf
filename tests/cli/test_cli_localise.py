"""`rbpf run mono … --map M --localize` on a rendered desk: its first part is mapped, the rest found in that map."""

import shutil

import numpy as np
import pytest
import yaml

from rbpf.cli import main
from rbpf.runs.trajectory import associate, read_tum
from rbpf.sensors.camera import Pinhole
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.cli.sequences import run, sentence, summary

CAMERA = Pinhole(320, 240, 256.0, 256.0, 159.5, 119.5)
MAPPED, FRAMES = 90, 115


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered") / "desk"
    simulate_images(TexturedDesk(frames=FRAMES, texel_m=0.002), Imaging(jpeg=90), CAMERA, folder, seed=3)
    return folder


@pytest.fixture(scope="module")
def halves(desk, tmp_path_factory):
    """The first part with its known points, the rest without, each with its truth in the same world."""
    parts = []
    for name, kept in (("first", range(MAPPED)), ("rest", range(MAPPED, FRAMES))):
        folder = tmp_path_factory.mktemp("halves") / name
        shutil.copytree(desk, folder)
        camera = folder / "mav0" / "cam0"
        lines = (camera / "data.csv").read_text().splitlines(keepends=True)
        (camera / "data.csv").write_text("".join([lines[0], *(lines[1 + k] for k in kept)]))
        parts.append(folder)
    (parts[1] / "known_points.csv").unlink()
    return parts


@pytest.fixture(scope="module")
def mapped(halves, tmp_path_factory):
    out = tmp_path_factory.mktemp("mapped") / "run"
    assert run(halves[0], out, "--particles", "50") == 0
    return out


@pytest.mark.slow
def test_the_camera_is_found_in_the_map_of_an_earlier_run(halves, mapped, tmp_path):
    map_before = (mapped / "known_map.npz").read_bytes()
    out = tmp_path / "run"
    assert run(halves[1], out, "--map", str(mapped), "--localize", "--particles", "50", "--batch") == 0
    entries = summary(out)
    assert entries["localized"] and entries["found_at_frame"] == 0
    assert entries["frames"] == FRAMES - MAPPED and entries["lost_frames"] == 0
    # In the map's world, which is the truth's; the map itself is some millimetres off.
    assert entries["path_rmse_m"] < 0.02 and entries["landmarks_partial"] == 0
    assert "batch_problem" not in entries and entries["batch_path_rmse_m"] < 0.02
    # Filter and optimum are compared in the map's world, as the comparison of a folder does.
    poses, batch = (read_tum(out / name) for name in ("trajectory.tum", "batch.tum"))
    apart = ate(*associate(poses, batch, 0)).rmse
    assert entries["filter_minus_batch_rmse_m"] == pytest.approx(apart, rel=1e-9)
    assert (mapped / "known_map.npz").read_bytes() == map_before
    with np.load(mapped / "known_map.npz") as before, np.load(out / "map.npz") as after:
        np.testing.assert_allclose(after["mean"], before["positions"], atol=1e-12)
    assert not (out / "known_map.npz").exists()
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["known_map"] == str(mapped / "known_map.npz") and config["localize"] is True
    (mapped / "timings.csv").unlink()  # of the map's run nothing else counts
    again = ["run", "--from", str(out / "config.yaml"), "--out", str(tmp_path / "again"), "--no-video"]
    assert main(again) == 0
    assert (tmp_path / "again" / "trajectory.tum").read_bytes() == (out / "trajectory.tum").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--localize",), "with both: --map RUN --localize"),
        (("--map", "somewhere"), "with both: --map RUN --localize"),
        (("--map", "somewhere", "--localize"), "somewhere: there is no such map"),
        (("--map", "m", "--localize", "--board", "9x6", "--square", "0.02"), "leave out known points"),
    ],
)
def test_options_that_make_no_sense(tmp_path, capsys, arguments, words):
    (tmp_path / "sequence").mkdir()
    shutil.copy(__file__, tmp_path / "sequence" / "camera.yaml")
    assert run(tmp_path / "sequence", tmp_path / "run", *arguments, known=False) == 2
    assert words in " ".join(sentence(capsys).split()) and not (tmp_path / "run").exists()
