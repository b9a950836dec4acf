"""python -m benchmarks [names] [--quick] [--gate] [--record]."""

import argparse
import json
import sys
import time
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.asked import verdict
from benchmarks.gate import regressions, write_baseline
from benchmarks.machine import description
from benchmarks.rows import Row, Settings, SkippedError

FOLDER = Path(__file__).parent
BASELINE = FOLDER / "baseline.json"
NAMES = (
    "start_up",
    "stereo_memory",  # before others: a process's peak starts at its parent's memory
    "small_update",
    "many_particles",
    "map_size",
    "submaps",
    "sharing",
    "genealogy_growth",
    "user_model",
    "mono_step",
    "mono_frames",
    "mono_map_size",
    "patch_search",
    "descriptor_search",
    "motion_estimate",
    "stereo_step",
    "stereo_frames",
    "bootstrap_peers",
    "mrpt_peer",
)


def main() -> int:
    """Runs, prints, and writes results.json if all were run; returns 1 if the gate finds a regression."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="name", help=f"any of: {', '.join(NAMES)}; by default all")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--gate", action="store_true", help="compare with baseline.json, exit 1 on a regression")
    parser.add_argument("--record", action="store_true", help="write baseline.json from this run")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(NAMES))
    if unknown:
        parser.error(f"no benchmark is called {unknown[0]}: choose from {', '.join(NAMES)}")

    machine, rows = description(), []
    for name in arguments.names or NAMES:
        start = time.perf_counter()
        try:
            rows += import_module(f"benchmarks.{name}").run(Settings(arguments.quick))
            print(f"{name}: {time.perf_counter() - start:.1f} s", file=sys.stderr)
        except SkippedError as reason:
            print(f"{name}: skipped, {reason}", file=sys.stderr)
    show(rows, machine)
    partial = bool(arguments.names)
    if not partial:
        results = {"machine": machine, "quick": arguments.quick, "rows": [row.plain() for row in rows]}
        text = json.dumps(results, indent=1, ensure_ascii=False) + "\n"
        (FOLDER / "results.json").write_text(text, encoding="utf-8")
    if arguments.record:
        write_baseline(BASELINE, rows, partial)
    if not arguments.gate:
        return 0
    sentences = regressions(BASELINE, rows, partial)
    for sentence in sentences:
        print(sentence)
    return 1 if sentences else 0


def show(rows: list[Row], machine: dict[str, object]) -> None:
    """Prints the table, then the notes."""
    console = Console(width=150 if not sys.stdout.isatty() else None)
    table = Table(title=", ".join(f"{key} {value}" for key, value in machine.items()))
    for heading in ("benchmark", "figure", "floor", "ratio", "asked", "goal", ""):
        table.add_column(heading)
    for row in rows:
        against = f"{row.baseline_figure:.4g} {row.unit}: {row.baseline}"
        table.add_row(row.name, f"{row.figure:.4g} {row.unit}", against, f"{row.ratio:.3g}", *verdict(row))
    console.print(table)
    for row in rows:
        console.print(f"{row.name}: {row.notes}", highlight=False, markup=False)


if __name__ == "__main__":
    sys.exit(main())
