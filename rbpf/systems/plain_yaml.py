"""YAML files of plain values: nothing in them is run, nothing unfolds into more than the file holds."""

from pathlib import Path
from typing import Any

import yaml

from rbpf.errors import InputError

MOST_BYTES = 1 << 20
"""Settings are a few kilobytes."""


def read_plain_yaml(path: Path) -> Any:
    """What a YAML file says: mappings, lists, text, numbers.

    Raises:
        InputError: the file is missing, unreadable, too large, no YAML, or refers to itself by aliases.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} has more than {MOST_BYTES} bytes: expected a file of settings")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read: {error}") from error
    try:
        # A few nested aliases stand for more values than memory holds.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise InputError(f"{path} has an alias (*name): write the values out")
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    except (LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise InputError(f"{path} holds a value that is none of its type") from error
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} holds a value that is none of its type: {error}") from error
