"""Every example runs, prints something, and shows what its page in the documentation says that it shows."""

import ast
import importlib
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

ROOT = Path(__file__).resolve().parents[2]
SECONDS_LONG = {
    "mono_blackouts", "mono_loop", "mono_overconfidence", "mono_still_camera", "mono_video", "reproduce_s05",
}  # fmt: skip
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LONGEST_SENSOR = 40


def batch_check(figures: dict[str, float]) -> None:
    assert figures["filter"] < 0.5 * figures["odometry alone"]
    assert figures["from_batch"] < 0.1


def checkpoint(figures: dict[str, bool]) -> None:
    assert figures["same"]
    assert figures["refused"]


def custom_sensor(figures: dict[str, float]) -> None:
    assert figures["findings"] == 0
    assert figures["filter"] < 0.25 * figures["odometry"]
    assert 0.8 < figures["nis_per_dof"] < 1.25


def evidence(figures: dict[float, float]) -> None:
    low, right, high = figures.values()
    assert right > max(low, high) + 3.0


def fused_kernel(figures: dict[str, float]) -> None:
    assert figures["findings"] == 0
    assert figures["difference"] < 1e-6
    assert figures["speedup"] > 1.0


def gps_fix(figures: dict[str, float]) -> None:
    assert figures["sigma_heading_end"] < 0.1 * figures["sigma_heading_start"]
    assert figures["position_rmse"] < 0.5 * 2**0.5
    assert figures["share_within_3_sigma"] > 0.95


def lab_images(figures: dict[str, dict[str, float]]) -> None:
    clear, dim = figures.values()
    assert dim["share matched, left to right"] < 0.9 * clear["share matched, left to right"]
    assert dim["disparity against the truth, px"] > 1.3 * clear["disparity against the truth, px"]
    assert 0.3 < dim["share matched, frame to frame"] + dim["share matched, left to right"] < 1.4
    assert dim["stereo matches"] > 50.0


def mono_blackouts(figures: dict[str, float]) -> None:
    assert figures["blackouts"] >= 2
    assert figures["recovered"] == 1.0
    assert figures["median error a second later [m]"] < 0.03


def mono_depth(figures: dict[str, float]) -> None:
    assert figures["kl_depth"] > 10.0 * figures["kl_inverse"]
    assert figures["kl_depth_end"] < 0.01


def mono_desk(figures: dict[str, float]) -> None:
    assert 1.0 < figures["ratio"] < 2.5
    assert 3.0 < figures["nees"] < 15.0


def mono_eigenvalues(figures: dict[str, float]) -> None:
    assert figures["dominant"] < 45
    assert figures["thirtieth"] < 0.05


def mono_loop(figures: dict[str, float]) -> None:
    assert figures["loop / room's prior"] < 0.5 * figures["loop / desk's prior"]


def mono_overconfidence(figures: dict[str, float]) -> None:
    assert figures["default / points"] > 3.0 * figures["default / frame"]


def mono_still_camera(figures: dict[str, float]) -> None:
    assert figures["epipolar / points / stay rays"] < 0.1
    assert figures["epipolar / frame / stay rays"] < 0.5
    assert figures["off / frame / become points"] < 0.5


def mono_video(figures: dict[str, float]) -> None:
    assert figures["frames_tracked"] == 20
    assert figures["ate_rmse_m"] < 0.02


def own_landmark(figures: dict[str, float]) -> None:
    assert figures["findings"] == 0
    assert figures["located"] >= 25
    assert figures["map"] < 0.5
    assert figures["path"] < 0.2


def own_proposal(figures: dict[float, tuple[float, float]]) -> None:
    errors, sizes = zip(*figures.values(), strict=True)
    assert max(errors) < 0.15
    assert sizes[0] > sizes[1] > sizes[2]


def range_only_beacons(figures: dict[str, float]) -> None:
    assert figures["promoted"] >= 4
    assert figures["map"] < 0.5
    assert figures["path"] < 0.3


def reproduce_s05(figures: dict[str, float]) -> None:
    assert figures["path, filter"] < 0.1
    assert figures["map, filter, aligned"] < figures["map, odometry, aligned"] + 0.05
    assert 0.0 < figures["mean ms of an update"] < 1e3 * figures["mean seconds per pair"]
    assert figures["mean seconds per pair"] < figures["the paper's"]


def smoothing(figures: dict[str, float]) -> None:
    assert figures["ancestral paths"] < 0.5 * figures["filter"]
    assert figures["backward"] < 0.5 * figures["filter"]


def target_tracking(figures: dict[str, dict[str, float]]) -> None:
    bootstrap, marginalised, refined = figures.values()
    for better in (marginalised, refined):
        assert better["position_rmse"] < bootstrap["position_rmse"]
        assert better["spread"] < 0.7 * bootstrap["spread"]


CLAIMS: dict[str, Callable[[Any], None]] = {
    claim.__name__: claim
    for claim in (
        batch_check,
        checkpoint,
        custom_sensor,
        evidence,
        fused_kernel,
        gps_fix,
        lab_images,
        mono_blackouts,
        mono_depth,
        mono_desk,
        mono_eigenvalues,
        mono_loop,
        mono_overconfidence,
        mono_still_camera,
        mono_video,
        own_landmark,
        own_proposal,
        range_only_beacons,
        reproduce_s05,
        smoothing,
        target_tracking,
    )
}


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in SECONDS_LONG))
        for path in EXAMPLES
    ],
)
def test_example_shows_what_it_promises(path, capsys, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(path.parent)
    main = importlib.import_module(path.stem).main
    draws = "quick" in inspect.signature(main).parameters
    figures = main(quick=True, out=tmp_path) if draws else main()
    assert {".png", ".csv"} <= {file.suffix for file in tmp_path.iterdir()} or not draws
    assert capsys.readouterr().out.count("\n") >= 2
    CLAIMS[path.stem](figures)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_uses_the_public_interface(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = [f"{node.module}.{alias.name}" for node in imports for alias in node.names]
    assert [name for name in names if name.startswith("rbpf")]
    assert not [name for name in names if re.search(r"\._", name)]
    assert ast.get_docstring(tree)


def test_a_new_sensor_takes_few_lines():
    tree = ast.parse((ROOT / "examples" / "custom_sensor.py").read_text(encoding="utf-8"))
    (sensor,) = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    assert sensor.end_lineno is not None
    assert sensor.end_lineno - sensor.lineno + 1 < LONGEST_SENSOR


def test_the_readme_s_program_runs(tmp_path, monkeypatch, capsys):
    (program,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    simulate_robot(RobotWorld(steps=20, landmarks=20), tmp_path / "log", seed=0)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, "README.md", "exec"), {})
    assert "log-evidence" in capsys.readouterr().out
