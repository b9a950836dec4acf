"""The commands, programs and files that README and documentation show."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)])

_FENCE = re.compile(r"^(`{3,})(.*)\n((?:.*\n)*?)\1 *$", re.MULTILINE)
_OPTION = re.compile(r"^:([\w-]+): *(.*)\n", re.MULTILINE)
_SHOWN_ELSEWHERE = ("{", "text", "")
"""Directives take their content from the code; text is output. Both are left to Sphinx."""


@dataclass(frozen=True)
class Block:
    """What stands between fences.

    Attributes:
        page: path from the project's root.
        line: of the opening fence.
        language: sh, python, yaml, …
        text: what stands there.
        file: name of the file that it shows, from the caption; empty if it is to be run.
    """

    page: str
    line: int
    language: str
    text: str
    file: str = ""


def blocks(page: Path) -> list[Block]:
    """Those of a page that are to be run or read."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        language, body, caption = match[2].strip(), match[3], ""
        if language.startswith("{code-block}"):
            language = language.split()[1]
            caption = dict(_OPTION.findall(body)).get("caption", "") if _OPTION.match(body) else ""
            body = _OPTION.sub("", body).lstrip("\n")
        if not language.startswith("{") and language not in _SHOWN_ELSEWHERE:
            line = text[: match.start()].count("\n") + 1
            found.append(Block(str(page.relative_to(ROOT)), line, language, body, caption))
    return found


def commands(block: Block) -> list[list[str]]:
    """The words of each command of a shell block, without comments."""
    lines = block.text.replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line for line in words if line]


def inline_commands(page: Path) -> list[list[str]]:
    """Commands of the project that stand in a sentence or a table, between backquotes."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    spans = re.findall(r"(?<!`)`((?:rbpf|python|make) [^`\n]+)`", text)
    return [shlex.split(span) for span in spans]
