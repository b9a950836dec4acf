"""Compiled code that a change of the sources has made wrong.

Numba's cache notices when a function's own file changes, not when a function or a constant that it uses does: an old
copy would go on with another block size and write outside its arrays.
"""

from contextlib import suppress
from functools import cache
from pathlib import Path

from numba import config

_PACKAGE = Path(__file__).resolve().parents[1]


def discard_stale(folder: Path) -> None:
    """Deletes compiled copies of the modules in a folder that are older than any kernel source of this package."""
    places = [folder / "__pycache__"]
    if config.CACHE_DIR:
        places = [place for place in Path(config.CACHE_DIR).glob("*") if place.is_dir()]
    for place in places:
        for index in place.glob("*.nbi"):
            with suppress(FileNotFoundError):  # another process may be doing the same
                if index.stat().st_mtime < _newest_source():
                    index.unlink()


@cache
def _newest_source() -> float:
    sources = [
        *_PACKAGE.glob("kernels/*.py"),
        *_PACKAGE.glob("*/*kernel*.py"),
        *_PACKAGE.glob("*/*/*kernel*.py"),
    ]
    return max(source.stat().st_mtime for source in sources)
