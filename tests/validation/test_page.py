"""What stands on a run's page, and the pictures that anybody may draw."""

import json
import re
from base64 import b64decode
from dataclasses import asdict
from gzip import decompress

import numpy as np
import pytest
from matplotlib.figure import Figure
from plotly.graph_objects import Figure as Scene

import rbpf
from rbpf.cli import main
from rbpf.runs.plots import World
from rbpf.runs.provenance import command_of
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.report.page import digits, program, scene, write_report
from rbpf.validation.simulation.laser import LaserWorld, simulate_laser
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

pytestmark = pytest.mark.usefixtures("plain_pictures")


@pytest.fixture(scope="module")
def two(tmp_path_factory, plain_pictures):
    """Folders of two runs over one recording in space."""
    folder = tmp_path_factory.mktemp("two")
    simulate_robot(RobotWorld(steps=20, landmarks=20, spatial=True), folder / "log", seed=0)
    for seed in (0, 1):
        arguments = ["--out", str(folder / f"run{seed}"), "--particles", "20", "--seed", str(seed), "--no-batch"]
        assert main(["run", "range-bearing", str(folder / "log"), *arguments]) == 0
    return folder / "run0", folder / "run1"


@pytest.mark.parametrize(
    ("value", "name", "said"),
    [
        (0.00432, "ate_rmse_m", "4.32 mm"),
        (12.3456, "ate_rmse_m", "12.3 m"),
        (7110.34, "log_evidence", "7,110"),
        (0.5, "rotation_deg", "0.500°"),
        (1234, "frames", "1,234"),
        (7.28e-115, "nis", "7.3e-115"),
        (0.0, "nis", "0.00"),
        (9.996, "nis", "10.00"),
        (True, "x", "True"),
    ],
)
def test_numbers_have_three_digits_and_a_unit(value, name, said):
    assert digits(value, name) == said


def test_a_command_names_what_is_not_the_default():
    usual = asdict(MonoConfig())
    entries = {"rbpf": "0", "system": "mono", "recording": "a b", **usual, "particles": 7, "known_points": "k.csv"}
    entries |= {"map": "particles", "search": usual["search"] | {"noise_px": 0.5}, "video": False}
    words = command_of(entries, usual)
    assert words[:4] == ["rbpf", "run", "mono", "a b"] and "--no-video" in words
    rest = " ".join(words[4:])
    for part in ("--known-points k.csv", "--particles 7", "--set map=particles", "--set search.noise_px=0.5"):
        assert part in rest
    assert words.count("--set") == 2


def test_the_page_has_a_head_a_scene_and_no_empty_section(two):
    write_report(two[0])
    text = (two[0] / "report.html").read_text()
    command = re.search(r"<pre>(.*)</pre>", text)[1]
    assert command.startswith("rbpf run range-bearing ") and command.endswith("--no-batch --particles 20")
    assert '<meta name="viewport"' in text and len(text) < 8e6
    for section in text.split("<h2>")[1:]:
        assert len(re.sub(r"<[^>]+>", "", section.partition("</h2>")[2]).split()) + section.count("<img") > 0
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    assert len(captions) >= 6 and all(captions)
    vectors = re.findall(r'<a href="(\w+\.pdf)">PDF</a></figcaption>', text)
    assert len(vectors) == len(captions) and all((two[0] / name).read_bytes().startswith(b"%PDF") for name in vectors)
    packed = re.search(r'id="plotly">([^<]+)<', text)[1]
    assert packed == program() and b"plotly.js v" in decompress(b64decode(packed))[:200]
    told = json.loads(re.search(r'id="traces">([^<]+)<', text)[1])
    names = {trace["name"] for trace in told["data"]}
    assert names == {"path", "truth", "odometry alone", "poses", "landmarks", "3σ"}


def numbers_of(trace) -> np.ndarray:
    return np.array([np.frombuffer(b64decode(trace[axis]["bdata"]), trace[axis]["dtype"]) for axis in "xyz"]).T


def test_the_scene_shows_the_path_and_ellipsoids_where_they_are(two):
    found = rbpf.load(two[0])
    told = json.loads(scene(found, World.of(found)))
    Scene(told)  # plotly knows every name and value
    traces = {trace["name"]: trace for trace in told["data"]}
    np.testing.assert_allclose(numbers_of(traces["path"]), found.trajectory.positions, atol=1e-5)
    mesh = traces["3σ"]
    corners = numbers_of(mesh).reshape(-1, 56, 3)
    whole = found.map.points()
    for corner in corners:
        k = np.argmin(np.linalg.norm(whole.mean - corner.mean(axis=0), axis=1))
        offset = corner - whole.mean[k]
        distance = np.sqrt(np.einsum("pa,ab,pb->p", offset, np.linalg.inv(whole.cov[k]), offset))
        np.testing.assert_allclose(distance, 3.0, rtol=1e-2)
    faces = np.array([np.frombuffer(b64decode(mesh[c]["bdata"]), "i4") for c in "ijk"])
    assert faces.min() == 0 and faces.max() == corners.size // 3 - 1


def test_a_scanner_s_scene_has_its_walls(tmp_path):
    simulate_laser(LaserWorld(scans=12), tmp_path / "log", seed=0)
    assert (
        main(["run", "laser", str(tmp_path / "log" / "robot.clf"), "--particles", "3", "--out", str(tmp_path / "run")])
        == 0
    )
    found = rbpf.load(tmp_path / "run")
    told = json.loads(scene(found, World.of(found)))
    walls = next(trace for trace in told["data"] if trace["name"] == "walls")
    assert len(numbers_of(walls)) == (found.grid.log_odds > 0).sum() > 100
    assert 'id="scene"' in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize("draw", [rbpf.plot_trajectory, rbpf.plot_map, rbpf.plot_consistency, rbpf.plot_error])
def test_pictures_are_drawn_into_axes_that_are_given(two, draw):
    axes = Figure().subplots()
    found = rbpf.load(two[0])
    assert draw(found, ax=axes) is axes.figure and axes.lines
    assert draw(found) is not axes.figure


def test_paths_of_two_runs_are_in_one_world(two):
    axes = Figure().subplots()
    runs = [rbpf.load(run) for run in two]
    rbpf.plot_trajectory(*runs, ax=axes)
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    for run in runs:
        np.testing.assert_allclose(lines[run.folder.name], run.trajectory.positions[:, :2])
    assert {"truth", "run0", "run1"} <= lines.keys()


def test_runs_are_plotted_beside_one_another(two, tmp_path, capsys):
    assert main(["plot", *map(str, two), "--out", str(tmp_path), "--format", "png", "svg", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert sorted(told["files"]) == sorted(path.name for path in tmp_path.iterdir())
    assert {"path.svg", "error.png", "consistency.svg"} <= set(told["files"])
    assert (tmp_path / "path.svg").read_text().startswith("<?xml")
    assert main(["plot", str(two[0]), "--out", str(tmp_path / "one"), "--format", "pdf"]) == 0
    assert (tmp_path / "one" / "map.pdf").read_bytes().startswith(b"%PDF")
    assert main(["plot", "--out", str(tmp_path)]) == 2
