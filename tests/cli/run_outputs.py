"""What two runs that should be the same are compared by: everything in their folders that does not tell times."""

import json
from pathlib import Path
from typing import Any

TIMED_FILES = {"timings.csv", "timings.png", "timings.pdf", "report.html", "checkpoint.npz"}
TIMED_ENTRIES = {"ms_per_frame", "ms_per_update", "peak_memory_mb", "finished"}


def untimed_summary(folder: Path) -> dict[str, Any]:
    """summary.json without times and memory."""
    entries = json.loads((folder / "summary.json").read_text())
    return {name: value for name, value in entries.items() if name not in TIMED_ENTRIES}


def names(folder: Path) -> set[str]:
    """Of all files; each picture lies there as vectors, too, which is not told again."""
    found = {path.name for path in folder.iterdir()}
    pictures, vectors = ({name[:-4] for name in found if name.endswith(ending)} for ending in (".png", ".pdf"))
    assert pictures == vectors
    return {name for name in found if not name.endswith(".pdf")}


def outputs(folder: Path) -> dict[str, bytes]:
    """The bytes of all files but timings, by name; of summary.json those of its other entries."""
    kept = {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in TIMED_FILES}
    return kept | {"summary.json": json.dumps(untimed_summary(folder)).encode()}
