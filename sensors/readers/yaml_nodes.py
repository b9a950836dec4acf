"""YAML as nodes instead of values: they know their lines, and no tag in the file can construct anything."""

from pathlib import Path

import yaml

from rbpf.errors import InputError
from rbpf.sensors.readers.text import line_error


def compose(path: Path, text: str, hint: str) -> yaml.Node:
    """The node that a file's text is.

    Args:
        path: the file, for messages.
        text: its text.
        hint: what is expected to lie there.

    Raises:
        InputError: the text is no YAML, or holds nothing but comments.
    """
    try:
        node = yaml.compose(text, Loader=yaml.BaseLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise line_error(path, line, f"expected YAML, found a syntax error ({error.problem})") from None
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError):
        raise InputError(f"{path}: expected YAML, found something else.") from None
    if node is None:
        raise InputError(f"{path}: expected {hint}, found only comments.")
    return node
