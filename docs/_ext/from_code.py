"""Directives whose content is taken from the program when the documentation is built, so that it stays true.

```{settings} mono                   every setting of a system's run
```{command-help} run range-bearing  what `rbpf run range-bearing --help` prints
```{modules} rbpf.maps               the modules of a package, each under a heading
```{examples}                        every program of examples/ with the first sentence of its docstring
"""

import ast
import os
from contextlib import redirect_stdout, suppress
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import cleandoc, getdoc
from io import StringIO
from pathlib import Path
from pkgutil import iter_modules
from re import DOTALL, search, sub
from textwrap import fill
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst.directives import flag, unchanged
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

WIDTH = 100
"""Columns of a page, without scrolling."""
_MODULE = "## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n{members}```\n\n"


class Settings(SphinxDirective):
    """Name, default and meaning of each field of a configuration and of the configurations inside it."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """A table for the run and one for each group."""
        from rbpf.runs.recordings import SYSTEMS

        config = SYSTEMS[self.arguments[0]].config()
        return [node for name, part in _groups("", config) for node in _table(name, part)]


class CommandHelp(SphinxDirective):
    """The help text of a command."""

    optional_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """A literal block."""
        from rbpf.cli import main

        os.environ.update(COLUMNS=str(WIDTH), NO_COLOR="1")
        command = self.arguments[0].split() if self.arguments else []
        text = StringIO()
        with redirect_stdout(text), suppress(SystemExit):
            main([*command, "--help"])
        # The program breaks its tables to the width, and leaves sentences and the names of commands to the terminal.
        lines = (_broken(line) for line in text.getvalue().splitlines())
        return [nodes.literal_block(text="\n".join(lines), language="text")]


def _broken(line: str) -> str:
    """A line in lines of the page's width."""
    if len(line) <= WIDTH:
        return line
    return fill(sub(r",(?=\S)", ", ", line), WIDTH, subsequent_indent="  ", break_on_hyphens=False)


class Modules(SphinxDirective):
    """The reference of every module in a package, without those of its packages."""

    required_arguments = 1
    option_spec: ClassVar = {"no-members": flag, "except": unchanged}

    def run(self) -> list[nodes.Node]:
        """A section per module."""
        package = self.arguments[0]
        left_out = self.options.get("except", "").split()
        found = [item.name for item in iter_modules(import_module(package).__path__) if not item.ispkg]
        names = [f"{package}.{name}" for name in found if name not in left_out and not name.startswith("_")]
        members = "   :no-members:\n" if "no-members" in self.options else ""
        text = "".join(_MODULE.format(name=name, members=members) for name in names)
        return self.parse_text_to_nodes(text, allow_section_headings=True)


class Examples(SphinxDirective):
    """What each example is about."""

    def run(self) -> list[nodes.Node]:
        """A list."""
        listed = nodes.bullet_list()
        for path in sorted((Path(self.env.srcdir).parent / "examples").glob("*.py")):
            about = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")[0]
            text = nodes.Text(f": {' '.join(about.split())}")
            listed += nodes.list_item("", nodes.paragraph("", "", nodes.literal(text=path.name), text))
        return [listed]


def _groups(name: str, config: Any) -> list[tuple[str, Any]]:
    inner = [(item.name, getattr(config, item.name)) for item in fields(config)]
    nested = [group for key, value in inner if is_dataclass(value) for group in _groups(f"{name}{key}.", value)]
    return [(name, config), *nested]


def _table(name: str, config: Any) -> list[nodes.Node]:
    meanings = _attributes(type(config))
    rows = [(f"{name}{item.name}", getattr(config, item.name), meanings[item.name]) for item in fields(config)]
    table = nodes.table(classes=["settings"])
    group = nodes.tgroup(cols=3)
    table += group
    group += [nodes.colspec(colwidth=width) for width in (30, 15, 55)]
    group += nodes.thead("", _row([nodes.Text(head) for head in ("setting", "default", "meaning")]))
    body = nodes.tbody()
    group += body
    for key, value, meaning in rows:
        if not is_dataclass(value):
            body += _row([nodes.literal(text=key), nodes.literal(text=_shown(value)), nodes.Text(meaning)])
    summary = cleandoc(type(config).__doc__ or "").split("\n")[0]
    return [nodes.paragraph(text=summary), table]


def _attributes(kind: type) -> dict[str, str]:
    """Texts of its fields: comments `#: …` at them, or the section `Attributes:` of a Google-style docstring."""
    meanings: dict[str, str] = {}
    for part in [part for part in reversed(kind.__mro__) if is_dataclass(part)]:
        comments = ModuleAnalyzer.for_module(part.__module__).find_attr_docs()
        meanings |= {name: " ".join(lines).strip() for (of, name), lines in comments.items() if of == part.__name__}
    found = search(r"Attributes:\n(.*)", getdoc(kind) or "", DOTALL)
    for line in [] if found is None else found[1].split("\n"):
        if named := search(r"^ {4}(\w+): (.*)", line):
            meanings[named[1]] = named[2]
        elif line.strip():
            meanings[next(reversed(meanings))] += " " + line.strip()
    return meanings


def _shown(value: Any) -> str:
    return str(value).lower()


def _row(cells: list[nodes.Node]) -> nodes.row:
    return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", cell)) for cell in cells))


def setup(app: Sphinx) -> dict[str, Any]:
    """Registers the directives."""
    app.add_directive("settings", Settings)
    app.add_directive("command-help", CommandHelp)
    app.add_directive("modules", Modules)
    app.add_directive("examples", Examples)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
