"""Compares a run's ratios with the committed ones."""

import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.rows import Row


def write_baseline(path: Path, rows: Sequence[Row], partial: bool) -> None:
    """Writes ratios and tolerances by name; in a `partial` run those of the others stay."""
    kept = json.loads(path.read_text(encoding="utf-8")) if partial else {}
    figures = kept | {
        row.name: {
            "ratio": round(row.ratio, 4),
            "higher": row.higher,
            "tolerance": row.tolerance,
            "optional": row.optional,
        }
        for row in rows
    }
    path.write_text(json.dumps(figures, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def regressions(path: Path, rows: Sequence[Row], partial: bool) -> list[str]:
    """Sentences about rows that got worse by more than their tolerance, or have no baseline.

    Unless the run is `partial`, also about rows of the baseline that are missing in the run.
    """
    baseline = json.loads(path.read_text(encoding="utf-8"))
    measured = {row.name: row.ratio for row in rows}
    sentences = [f"{name}: no baseline, record one" for name in measured if name not in baseline]
    for name, entry in baseline.items():
        if name not in measured:
            if not partial and not entry["optional"]:
                sentences.append(f"{name}: no figure in this run")
            continue
        change = measured[name] / entry["ratio"] - 1.0
        if (-change if entry["higher"] else change) > entry["tolerance"]:
            sentences.append(
                f"{name}: ratio {measured[name]:.3g} against {entry['ratio']:.3g}, "
                f"a change of {change:+.0%} where {entry['tolerance']:.0%} is allowed"
            )
    return sentences
