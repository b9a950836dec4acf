"""YAML files of which every value knows its line; no tag of a file can construct anything that is not plain."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from rbpf.errors import InputError
from rbpf.sensors.readers.text import line_error, parse_number, quoted, read_text

DEEPEST = 20  #: Lists and mappings within each other.
MOST_BYTES = 1 << 20  #: Settings and calibrations are a few kilobytes.
#: That of libyaml, in a tenth of the time, where PyYAML was built with it.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class YamlValue:
    """A value in a YAML file, and its key; whoever asks for what it is not gets an InputError that names its line."""

    path: Path
    name: str
    node: yaml.Node

    def error(self, problem: str) -> InputError:
        """Error that points at the value's line."""
        return line_error(self.path, self.node.start_mark.line + 1, problem)

    def entries(self, required: Collection[str], optional: Collection[str] | None = None) -> dict[str, "YamlValue"]:
        """Values of a mapping by their keys, each once: those that must be there and others that may be, None for any."""
        expected = f"expected the keys {', '.join(required)}"
        if not isinstance(self.node, yaml.MappingNode):
            raise self.error(f"{expected}, found no mapping such as `{next(iter(required))}: ...`")
        found: dict[str, YamlValue] = {}
        for key, node in self.node.value:
            name = YamlValue(self.path, "a key", key).text()
            if name in found:
                raise YamlValue(self.path, name, key).error(f"{name} comes a second time, expected it once")
            if optional is not None and name not in required and name not in optional:
                others = f"; also known: {', '.join(optional)}" if optional else ""
                raise YamlValue(self.path, name, key).error(f"{expected}{others}; found {quoted(name)}")
            found[name] = YamlValue(self.path, name, node)
        for name in required:
            if name not in found:
                raise self.error(f"{expected}, found no {name}")
        return found

    def text(self) -> str:
        """A single value: no list and no mapping."""
        if not isinstance(self.node, yaml.ScalarNode):
            raise self.error(f"expected {self.name} to be a single value, found a list or a mapping")
        return str(self.node.value)

    def choice(self, allowed: Collection[str]) -> str:
        """One of a few words."""
        text = self.text()
        if text not in allowed:
            raise self.error(f"expected {self.name} to be {' or '.join(allowed)}, found {quoted(text)}")
        return text

    def number(self) -> float:
        """A finite number."""
        return parse_number(self.path, self.node.start_mark.line + 1, self.name, self.text())

    def positive(self) -> float:
        """A positive number."""
        value = self.number()
        if value <= 0.0:
            raise self.error(f"expected {self.name} to be positive, found {value:.12g}")
        return value

    def size(self) -> int:
        """A positive whole number."""
        value = self.positive()
        if value != int(value):
            raise self.error(f"expected {self.name} to be a whole number, found {value:.12g}")
        return int(value)

    def items(self, *lengths: int) -> list["YamlValue"]:
        """Values of a list of one of these lengths."""
        expected = f"expected {self.name} to be a list of {' or '.join(map(str, lengths))}"
        if not isinstance(self.node, yaml.SequenceNode):
            raise self.error(f"{expected}, found no list")
        if len(self.node.value) not in lengths:
            raise self.error(f"{expected}, found {len(self.node.value)}")
        return [YamlValue(self.path, f"{self.name}[{i}]", node) for i, node in enumerate(self.node.value)]


def read_yaml(path: Path, hint: str) -> YamlValue:
    """Content of a YAML file; `hint` is what is expected to lie there, for messages.

    Raises InputError: the file is missing, too large, empty, or no YAML.
    """
    text = read_text(path, hint, MOST_BYTES)
    if text.startswith("%YAML:"):
        # OpenCV writes this first line with a colon, which YAML does not have.
        text = "#" + text
    try:
        # Before anything is built: a few nested aliases stand for more values than memory holds, and what is nested
        # thousands deep takes minutes.
        depth = 0
        for event in yaml.parse(text, _LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            line = event.start_mark.line + 1 if event.start_mark else 1
            if depth > DEEPEST:
                raise line_error(path, line, f"expected values, found more than {DEEPEST} nested lists or mappings")
            if isinstance(event, yaml.AliasEvent):
                raise line_error(path, line, "found an alias (*name): write the values out")
        node = yaml.compose(text, Loader=_LOADER)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise line_error(path, line, f"expected YAML, found a syntax error ({error.problem})") from None
    except InputError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError):
        raise InputError(f"{path}: expected YAML, found something else.") from None
    if node is None:
        raise InputError(f"{path}: expected {hint}, found only comments.")
    return YamlValue(path, "the file", node)


def read_plain_yaml(path: Path) -> Any:
    """What a YAML file says in plain values: mappings, lists, text, numbers, dates.

    Raises InputError: as `read_yaml`, a key comes twice, a tag is not plain, or a value is none of its type.
    """
    whole = read_yaml(path, "settings")
    _require_plain(whole)
    try:
        return yaml.SafeLoader("").construct_document(whole.node)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise line_error(path, line, f"expected plain values, found another tag ({error.problem})") from None
    except (LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, ValueError) as error:
        raise InputError(f"{path} holds a value that is none of its type: {error}") from None


def _require_plain(value: YamlValue) -> None:
    """Refuses keys that come twice."""
    if isinstance(value.node, yaml.MappingNode):
        for inner in value.entries(()).values():
            _require_plain(inner)
    elif isinstance(value.node, yaml.SequenceNode):
        for number, node in enumerate(value.node.value):
            _require_plain(YamlValue(value.path, f"{value.name}[{number}]", node))
