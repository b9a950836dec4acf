"""YAML files of which every value knows its line."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import yaml

from rbpf.errors import InputError
from rbpf.sensors.readers.table import parse_number
from rbpf.sensors.readers.text import line_error, quoted, read_text
from rbpf.sensors.readers.yaml_nodes import compose


@dataclass(frozen=True)
class YamlValue:
    """A value in a YAML file.

    Attributes:
        path: the file.
        name: its key, for messages.
        node: its text and line; no tag of the file can construct anything.
    """

    path: Path
    name: str
    node: yaml.Node

    def error(self, problem: str) -> InputError:
        """Error that points at the value's line."""
        return line_error(self.path, self.node.start_mark.line + 1, problem)

    def entries(self) -> dict[str, "YamlValue"]:
        """Values of a mapping by their keys.

        Raises:
            InputError: this is no mapping, or a key comes twice.
        """
        if not isinstance(self.node, yaml.MappingNode):
            raise self.error(f"expected {self.name} to be a mapping such as `fx: 525`, found none")
        found: dict[str, YamlValue] = {}
        for key, node in self.node.value:
            name = YamlValue(self.path, "a key", key).text()
            if name in found:
                raise YamlValue(self.path, name, key).error(f"{name} comes a second time, expected it once")
            found[name] = YamlValue(self.path, name, node)
        return found

    def require_keys(self, found: Collection[str], required: Collection[str]) -> None:
        """Refuse a mapping in which a key is missing.

        Raises:
            InputError: names the key.
        """
        for name in required:
            if name not in found:
                raise self.error(f"expected the keys {', '.join(required)}, found no {name}")

    def text(self) -> str:
        """A single value.

        Raises:
            InputError: it is a list or a mapping.
        """
        if not isinstance(self.node, yaml.ScalarNode):
            raise self.error(f"expected {self.name} to be a single value, found a list or a mapping")
        return str(self.node.value)

    def choice(self, allowed: Collection[str]) -> str:
        """One of a few words.

        Raises:
            InputError: it is another one.
        """
        text = self.text()
        if text not in allowed:
            raise self.error(f"expected {self.name} to be {' or '.join(allowed)}, found {quoted(text)}")
        return text

    def number(self) -> float:
        """A finite number.

        Raises:
            InputError: it is none.
        """
        return parse_number(self.path, self.node.start_mark.line + 1, self.name, self.text())

    def positive(self) -> float:
        """A positive number.

        Raises:
            InputError: it is none.
        """
        value = self.number()
        if value <= 0.0:
            raise self.error(f"expected {self.name} to be positive, found {value:.12g}")
        return value

    def size(self) -> int:
        """A positive whole number.

        Raises:
            InputError: it is none.
        """
        value = self.positive()
        if value != int(value):
            raise self.error(f"expected {self.name} to be a whole number, found {value:.12g}")
        return int(value)

    def items(self, *lengths: int) -> list["YamlValue"]:
        """Values of a list.

        Args:
            lengths: how many there may be.

        Raises:
            InputError: it is no list, or has another length.
        """
        expected = f"expected {self.name} to be a list of {' or '.join(map(str, lengths))}"
        if not isinstance(self.node, yaml.SequenceNode):
            raise self.error(f"{expected}, found no list")
        if len(self.node.value) not in lengths:
            raise self.error(f"{expected}, found {len(self.node.value)}")
        return [YamlValue(self.path, f"{self.name}[{i}]", node) for i, node in enumerate(self.node.value)]


def read_yaml(path: Path, hint: str) -> YamlValue:
    """Content of a YAML file.

    Args:
        path: the file.
        hint: what is expected to lie there, for the message.

    Raises:
        InputError: the file is missing, empty or no YAML.
    """
    text = read_text(path, hint)
    if text.startswith("%YAML:"):
        # OpenCV writes this first line with a colon, which YAML does not have.
        text = "#" + text
    return YamlValue(path, "the file", compose(path, text, hint))
