"""YAML files whose values know their lines; tags cannot construct anything but plain values."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from rbpf.errors import InputError
from rbpf.sensors.readers.text import line_error, parse_number, quoted, read_text

DEEPEST = 20  #: Maximum nesting of lists and mappings.
MOST_BYTES = 1 << 20  #: Settings and calibrations are a few kilobytes.
#: The loader of libyaml, ten times as fast, if PyYAML was built with it.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class YamlValue:
    """A value in a YAML file, and its key; reading it as a wrong type raises an InputError that names its line."""

    path: Path
    name: str
    node: yaml.Node

    def error(self, problem: str) -> InputError:
        """Error that points at the value's line."""
        return line_error(self.path, self.node.start_mark.line + 1, problem)

    def entries(self, required: Collection[str], optional: Collection[str] | None = None) -> dict[str, "YamlValue"]:
        """Values of a mapping by their distinct keys: the required ones and optional ones, None for any."""
        expected = f"expected the keys {', '.join(required)}"
        if not isinstance(self.node, yaml.MappingNode):
            raise self.error(f"{expected}, found no mapping such as `{next(iter(required))}: ...`")
        found: dict[str, YamlValue] = {}
        for key, node in self.node.value:
            name = YamlValue(self.path, "a key", key).text()
            if name in found:
                raise YamlValue(self.path, name, key).error(f"{name} occurs twice, expected it once")
            if optional is not None and name not in required and name not in optional:
                others = f"; also known: {', '.join(optional)}" if optional else ""
                raise YamlValue(self.path, name, key).error(f"{expected}{others}; found {quoted(name)}")
            found[name] = YamlValue(self.path, name, node)
        for name in required:
            if name not in found:
                raise self.error(f"{expected}, found no {name}")
        return found

    def text(self) -> str:
        """A scalar: neither a list nor a mapping."""
        if not isinstance(self.node, yaml.ScalarNode):
            raise self.error(f"expected {self.name} to be a single value, found a list or a mapping")
        return str(self.node.value)

    def choice(self, allowed: Collection[str]) -> str:
        """One of the `allowed` words."""
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
    """Content of a YAML file; `hint` describes the expected file, for messages.

    Raises InputError: the file is missing, too large, empty, or not YAML.
    """
    text = read_text(path, hint, MOST_BYTES)
    if text.startswith("%YAML:"):
        # OpenCV writes "%YAML:1.0", with a colon that YAML does not allow.
        text = "#" + text
    try:
        # Checked before construction: a few nested aliases can expand to more values than fit in memory, and thousands of
        # nested levels take minutes.
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
    """The content of a YAML file as plain values: mappings, lists, text, numbers, dates.

    Raises InputError: as `read_yaml`, a key occurs twice, a tag is not plain, or a value does not fit its type.
    """
    whole = read_yaml(path, "settings")
    _require_plain(whole)
    try:
        return yaml.SafeLoader("").construct_document(whole.node)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise line_error(path, line, f"expected plain values, found another tag ({error.problem})") from None
    except (LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, ValueError) as error:
        raise InputError(f"{path} has a value that does not fit its type: {error}") from None


def _require_plain(value: YamlValue) -> None:
    """Refuses duplicate keys."""
    if isinstance(value.node, yaml.MappingNode):
        for inner in value.entries(()).values():
            _require_plain(inner)
    elif isinstance(value.node, yaml.SequenceNode):
        for number, node in enumerate(value.node.value):
            _require_plain(YamlValue(value.path, f"{value.name}[{number}]", node))
