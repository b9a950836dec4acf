"""Settings from a YAML file, from key=value pairs and from the command line, in this order."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from rbpf.errors import InputError
from rbpf.ranges import SettingError, former_names
from rbpf.sensors.readers.yaml_files import read_plain_yaml

#: Entries of a config.yaml that are not settings.
HEADER = (
    "rbpf", "system", "versions", "input_sha256",
    "recording", "known_points", "board", "square_m", "calibration", "known_map", "localize",
    "aruco", "marker_m", "gap_m", "dictionary", "image_topic", "truth_topic", "video", "batch",
    "start_s", "end_s", "every", "resize_px", "scanner", "max_range", "upside_down",
)  # fmt: skip

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

#: User-facing words for msgspec's type names.
PLAIN = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "a word", "null": "nothing"}
PLAIN |= {"array": "a list", "object": "a group of settings"}

Config = TypeVar("Config", bound="DataclassInstance")


def load_settings(
    kind: type[Config], system: str, path: Path | None, pairs: Sequence[str], given: Mapping[str, Any]
) -> Config:
    """A configuration; later sources override earlier ones.

    Args:
        kind: dataclass of the settings.
        system: its name, as in a run's config.yaml.
        path: YAML file, such as the config.yaml of a former run.
        pairs: settings as key=value, nested keys with dots.
        given: settings by name.

    Raises InputError: the file is unreadable, a key does not exist or a value has the wrong type.
    """
    values = {} if path is None else read_plain_yaml(path)
    if not isinstance(values, dict):
        raise InputError(f"{path} must hold settings as `name: value`, one per line")
    if (found := values.get("system", system)) != system:
        raise InputError(f"{path} holds settings of the system {found!r}, not of {system}")
    values = {name: value for name, value in values.items() if name not in HEADER}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise InputError(f"--set takes key=value, got {pair!r}")
        *outer, last = key.split(".")
        group: Any = values
        for name in outer:
            group = group.setdefault(name, {})
            if not isinstance(group, dict):
                raise InputError(f"--set {pair}: {name} is no group of settings")
        group[last] = None if text in ("", "null", "none") else text
    values.update(given)
    _refuse_unknown(values, kind, "")
    try:
        return msgspec.convert(_over(asdict(defaults_of(kind, values)), values), kind, strict=False)
    except msgspec.ValidationError as error:
        # Examples: "Expected `int | null`, got `str` - at `$.search.measurements`", "Invalid enum value 'a' - at …", or a
        # range's own message and the group's path.
        words, _, place = str(error).partition(" - at `$")
        name = place.rstrip("`").lstrip(".")
        if isinstance(error.__cause__, SettingError):
            name, words = f"{name}.{error.__cause__.name}".lstrip("."), error.__cause__.words
        elif choices := _choices(kind, name.split("[")[0]):
            words = re.sub("^(Expected .*, got|Invalid enum value)", f"must be {' or '.join(choices)}, got", words)
        words = re.sub(
            "`(.+?)`", lambda types: " or ".join(PLAIN.get(one, one) for one in types[1].split(" | ")), words
        )
        raise InputError(f"settings: {name} {words.replace('Expected', 'must be')}") from error


def defaults_of(kind: type[Config], values: Mapping[str, Any]) -> Config:
    """The default settings of a system, which may depend on the given `values`."""
    return kind() if (chosen := getattr(kind, "defaults", None)) is None else chosen(values)


def _over(defaults: dict[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values merged into the system's defaults, which may differ from the defaults of a group's class."""
    both = dict(defaults)
    for name, value in values.items():
        inner = defaults.get(name)
        both[name] = _over(inner, value) if isinstance(inner, dict) and isinstance(value, dict) else value
    return both


def _choices(kind: Any, name: str) -> list[str]:
    """The allowed values of a setting."""
    *groups, last = name.split(".")
    for group in groups:
        kind = next(item.default_factory for item in fields(kind) if item.name == group)
    hint = get_type_hints(kind)[last]
    words = [str(word) for one in (hint, *get_args(hint)) if get_origin(one) is Literal for word in get_args(one)]
    return [*words, "nothing"] if words and type(None) in get_args(hint) else words


def _refuse_unknown(values: Mapping[str, Any], kind: Any, prefix: str) -> None:
    known = {item.name: item for item in fields(kind)}
    renamed = former_names(kind)
    for name, value in values.items():
        if name in renamed:
            raise InputError(f"the setting {prefix}{name} is now called {prefix}{renamed[name]}")
        if name not in known:
            raise InputError(f"there is no setting {prefix}{name}; known here: {', '.join(sorted(known))}")
        inner: Any = known[name].default_factory
        if isinstance(value, dict) and is_dataclass(inner):
            _refuse_unknown(value, inner, f"{prefix}{name}.")
        elif is_dataclass(inner):
            group = ", ".join(f"{prefix}{name}.{item.name}" for item in fields(inner))
            raise InputError(f"{prefix}{name} is a group of settings, of which each is set by itself: {group}")
