"""Every example and every study runs, prints something, and shows what its page in the documentation says it shows."""

import ast
import importlib
import inspect
import json
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
def test_example_shows_what_it_promises(path, capsys, monkeypatch, tmp_path, drawn_once):
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


@pytest.mark.slow
def test_the_notebook_runs_and_shows_what_its_cells_end_with(monkeypatch, tmp_path, plain_pictures):
    """Cells are code with a last expression that is shown: no more of a notebook is needed to run one."""
    cells = json.loads((ROOT / "examples" / "look_at_a_run.ipynb").read_text(encoding="utf-8"))["cells"]
    monkeypatch.chdir(tmp_path)
    names, shown = {}, []
    for cell in cells:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
            *statements, last = ast.parse("".join(cell["source"])).body
            exec(compile(ast.Module(statements, []), "notebook", "exec"), names)
            if isinstance(last, ast.Expr):
                shown.append(eval(compile(ast.Expression(last.value), "notebook", "eval"), names))
            else:
                exec(compile(ast.Module([last], []), "notebook", "exec"), names)
    run, *figures = [value for value in shown if value is not None]
    assert "ate_rmse_m" in run._repr_html_()
    assert len(figures) == 3 and all(figure._repr_png_().startswith(b"\x89PNG") for figure in figures)
    assert (tmp_path / "two.pdf").is_file()


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
