"""A group of commands that knows their names and options: what the parser says of others is long, or beside the point."""

from collections.abc import Callable, Iterable
from dataclasses import fields
from difflib import get_close_matches
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro
from tyro.extras import SubcommandApp

from rbpf.errors import InputError

Command = TypeVar("Command", bound=Callable[[], None])


class Commands(SubcommandApp):
    """Commands, and groups of them, by name; `first` is called before each command of the group."""

    def __init__(self, help: str | None = None, first: Callable[[], object] | None = None) -> None:
        super().__init__()
        self.__doc__ = help
        self.kinds: dict[str, Commands | type[Any]] = {}
        self._first = first

    def add(self, name: str) -> Callable[[type[Command]], type[Command]]:
        """Makes a dataclass a command of this name: its fields are the options, its call is what the command does."""

        def added(kind: type[Command]) -> type[Command]:
            def called(options: Any) -> None:
                if self._first is not None:
                    self._first()
                options()

            called.__doc__ = kind.__doc__
            called.__annotations__["options"] = Annotated[kind, tyro.conf.arg(name="")]
            self.kinds[name] = kind
            self.command(name=name)(called)
            return kind

        return added

    def add_group(self, name: str, group: "Commands") -> None:
        """Makes a group of commands a command of this name."""
        self.kinds[name] = group
        self.command(group, name=name)

    def require_known(self, arguments: list[str], before: str) -> None:
        """Refuses the name of a command or of an option that there is not; `before` are the words that led here."""
        if not arguments or arguments[0].startswith("-"):
            return
        name = arguments[0].replace("_", "-")
        if name not in self.kinds:
            hint = _nearest(name, self.kinds)
            raise InputError(f"there is no command `{before} {arguments[0]}`: {hint}")
        group, before = self.kinds[name], f"{before} {name}"
        if isinstance(group, Commands):
            group.require_known(arguments[1:], before)
            return
        options, hints = ["--help"], get_type_hints(group, include_extras=True)
        for field in fields(group):
            hint, option = hints[field.name], field.name.replace("_", "-")
            if tyro.conf.Positional not in getattr(hint, "__metadata__", ()):
                options += [f"--{option}", f"--no-{option}"] if hint is bool else [f"--{option}"]
        for word in arguments[1:]:
            option = word.partition("=")[0].replace("_", "-")
            if len(option) > 2 and option.startswith("--") and option not in options:
                hint = _nearest(option, options)
                raise InputError(f"`{before}` has no option {option}: {hint}")


def _nearest(name: str, names: Iterable[str]) -> str:
    """What may have been meant, or else all names."""
    close = get_close_matches(name, names, 1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(names)}"
