"""Docstrings are plain text with `code`, lists and Google sections: |S| or v* need no escapes there.

Before Napoleon reads a docstring, characters that mean something to reStructuredText alone are escaped
outside of `code`, and paragraphs that are indented or aligned in columns become literal blocks.
"""

import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any

from sphinx.application import Sphinx

_CODE = re.compile(r"(`[^`]*`)")
_SPECIAL = re.compile(r"[*|]|_(?!\w)")
_SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields):$")
_COLUMNS = re.compile(r"\S {3,}\S")


def plain(lines: list[str]) -> list[str]:
    """The lines as reStructuredText, with Google sections left as they are."""
    out: list[str] = []
    last = ""
    for paragraph in _paragraphs(lines):
        if _is_literal(paragraph, last):
            indent = min(len(line) - len(line.lstrip()) for line in paragraph)
            out += ["::", "", *("    " + line[indent:] for line in paragraph), ""]
        else:
            out += [*(_escaped(line) for line in paragraph), ""]
        last = paragraph[-1]
    return out


def _paragraphs(lines: list[str]) -> Iterator[list[str]]:
    for filled, group in groupby(lines, key=lambda line: bool(line.strip())):
        if filled:
            yield list(group)


def _is_literal(paragraph: list[str], before: str) -> bool:
    if paragraph[0].startswith("    "):
        return not before.startswith(" ")
    return not paragraph[0].startswith(" ") and any(_COLUMNS.search(line) for line in paragraph)


def _escaped(line: str) -> str:
    parts = _CODE.split(line)
    return "".join(part if part.startswith("`") else _SPECIAL.sub(r"\\\g<0>", part) for part in parts)


class _Hooks:
    """Before Napoleon and after it, as it takes what precedes a colon in the text of an attribute for a type."""

    def __init__(self) -> None:
        self._texts: dict[str, list[str]] = {}

    def before(self, app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
        lines[:] = plain(lines)
        if what in ("attribute", "data", "property") and not any(_SECTION.match(line) for line in lines):
            self._texts[name] = lines.copy()

    def after(self, app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
        lines[:] = self._texts.pop(name, lines)


def setup(app: Sphinx) -> dict[str, Any]:
    """Runs around Napoleon, whose priority is 500."""
    hooks = _Hooks()
    app.connect("autodoc-process-docstring", hooks.before, priority=400)
    app.connect("autodoc-process-docstring", hooks.after, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
