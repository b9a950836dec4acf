"""A group of commands that knows their names and options: what the parser says of others is long, or beside the point."""

from collections.abc import Callable, Iterable
from dataclasses import fields
from difflib import get_close_matches
from functools import wraps
from typing import Any, TypeVar, get_type_hints

import tyro
from tyro.extras import SubcommandApp

from rbpf.errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])


class Commands(SubcommandApp):
    """Commands, and groups of them, by name; `first` is called before each command of the group."""

    def __init__(self, help: str | None = None, first: Callable[[], object] | None = None) -> None:
        super().__init__()
        self.__doc__ = help
        self._groups: dict[str, Commands | Callable[..., Any]] = {}
        self._first = first

    def add(self, name: str) -> Callable[[Function], Function]:
        """Makes a function a command of this name."""

        def added(function: Any) -> Any:
            @wraps(function)
            def called(*arguments: Any, **named: Any) -> Any:
                if self._first is not None:
                    self._first()
                return function(*arguments, **named)

            self._groups[name] = function
            self.command(name=name)(called)
            return function

        return added

    def add_group(self, name: str, group: "Commands") -> None:
        """Makes a group of commands a command of this name."""
        self._groups[name] = group
        self.command(group, name=name)

    def require_known(self, arguments: list[str], before: str) -> None:
        """Refuses the name of a command or of an option that there is not; `before` are the words that led here."""
        if not arguments or arguments[0].startswith("-"):
            return
        name = arguments[0].replace("_", "-")
        if name not in self._groups:
            hint = _nearest(name, self._groups)
            raise InputError(f"there is no command `{before} {arguments[0]}`: {hint}")
        group, before = self._groups[name], f"{before} {name}"
        if isinstance(group, Commands):
            group.require_known(arguments[1:], before)
            return
        options = _options(group)
        for word in arguments[1:]:
            option = word.partition("=")[0].replace("_", "-")
            if len(option) > 2 and option.startswith("--") and option not in options:
                hint = _nearest(option, options)
                raise InputError(f"`{before}` has no option {option}: {hint}")


def _nearest(name: str, names: Iterable[str]) -> str:
    """What may have been meant, or else all names."""
    close = get_close_matches(name, names, 1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(names)}"


def _options(function: Callable[..., Any]) -> list[str]:
    """All options of a command, which are the fields of its argument."""
    kind = get_type_hints(function)["options"]
    found, hints = ["--help"], get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint, option = hints[field.name], field.name.replace("_", "-")
        if tyro.conf.Positional not in getattr(hint, "__metadata__", ()):
            found += [f"--{option}", f"--no-{option}"] if hint is bool else [f"--{option}"]
    return found
