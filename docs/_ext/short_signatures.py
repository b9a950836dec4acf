"""Signatures as they are written: `ArrayLike` by its name, and the axes of an array behind its type."""

import re
from typing import Any

from sphinx.application import Sphinx

_ARRAY_LIKE = re.compile(r"[~\w.]*_Buffer \| .*?_NestedSequence\[complex \| bytes \| str\]")
_AXES = re.compile(r"[~\w.]*Annotated\[([~\w.]+), ('[^']*')\]")


def shortened(signature: str) -> str:
    """With unions that NumPy calls ArrayLike under that name, and `Annotated[T, 'axes']` as `T['axes']`."""
    return _AXES.sub(r"\1[\2]", _ARRAY_LIKE.sub("ArrayLike", signature))


def process(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Both parts of a signature, where there are any."""
    return signature and shortened(signature), returned and shortened(returned)


def setup(app: Sphinx) -> dict[str, Any]:
    """Runs when autodoc has written a signature."""
    app.connect("autodoc-process-signature", process)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
