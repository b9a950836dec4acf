"""Every example and every study runs, prints something, and shows what its page in the documentation says it shows."""

import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

from tests.examples import claims

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
STUDIES = [path for path in sorted((ROOT / "examples" / "studies").glob("*.py")) if "def main(" in path.read_text()]
LONGEST_SENSOR, LONGEST_MODEL = 40, 60
PLUGGED_IN = ("grid_slam", "jump_markov", "gps_imu", "range_only_beacons", "stochastic_volatility")


@pytest.mark.slow
@pytest.mark.parametrize("path", [*EXAMPLES, *STUDIES], ids=lambda path: path.stem)
def test_example_shows_what_it_promises(path, capsys, monkeypatch, tmp_path, plain_pictures):
    monkeypatch.syspath_prepend(path.parent)
    main = importlib.import_module(path.stem if path in EXAMPLES else f"examples.studies.{path.stem}").main
    draws = "quick" in inspect.signature(main).parameters
    figures = main(quick=True, out=tmp_path) if draws else main()
    assert {".png", ".csv"} <= {file.suffix for file in tmp_path.iterdir()} or not draws
    assert capsys.readouterr().out.count("\n") >= 2
    for name, (low, high) in claims.BOUNDS.get(path.stem, {}).items():
        assert low <= figures[name] <= high, f"{name}: {figures[name]}"
    if path.stem not in claims.BOUNDS:
        getattr(claims, path.stem)(figures)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_uses_the_public_interface(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = [f"{node.module}.{alias.name}" for node in imports for alias in node.names]
    assert [name for name in names if name.startswith("rbpf")]
    assert not [name for name in names if re.search(r"\._", name)]
    assert ast.get_docstring(tree)


def lines_of_classes(name: str) -> int:
    tree = ast.parse((ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    return sum((node.end_lineno or 0) - node.lineno + 1 for node in classes)


@pytest.mark.parametrize("name", PLUGGED_IN)
def test_what_is_plugged_in_takes_few_lines(name):
    assert lines_of_classes("custom_sensor") < LONGEST_SENSOR
    assert 0 < lines_of_classes(name) < LONGEST_MODEL
