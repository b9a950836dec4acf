"""A group of commands that knows their names: the parser answers `nonsense --help` as if no command had been named."""

from collections.abc import Callable
from difflib import get_close_matches
from functools import wraps
from typing import Any, TypeVar

from tyro.extras import SubcommandApp

from rbpf.errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])


class Commands(SubcommandApp):
    """Commands, and groups of them, by name.

    Args:
        help: what the group is for.
        first: called before each command of the group.
    """

    def __init__(self, help: str | None = None, first: Callable[[], object] | None = None) -> None:
        super().__init__()
        self.__doc__ = help
        self._groups: dict[str, Commands | None] = {}
        self._first = first

    def add(self, name: str) -> Callable[[Function], Function]:
        """Makes a function a command of this name."""
        self._groups[name] = None
        if self._first is None:
            return self.command(name=name)
        first = self._first

        def after(function: Any) -> Any:
            @wraps(function)
            def called(*arguments: Any, **named: Any) -> Any:
                first()
                return function(*arguments, **named)

            return self.command(name=name)(called)

        return after

    def add_group(self, name: str, group: "Commands") -> None:
        """Makes a group of commands a command of this name."""
        self._groups[name] = group
        self.command(group, name=name)

    def require_known(self, arguments: list[str], before: str) -> None:
        """Refuses the name of a command that there is not.

        Args:
            arguments: as given; those of options are not looked at.
            before: the words that led here, for the message.

        Raises:
            InputError: the first argument names no command of this group, or the next one none of that one's.
        """
        if not arguments or arguments[0].startswith("-"):
            return
        name = arguments[0].replace("_", "-")
        if name not in self._groups:
            close = get_close_matches(name, self._groups, 1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(self._groups)}"
            raise InputError(f"there is no command `{before} {arguments[0]}`: {hint}")
        group = self._groups[name]
        if group is not None:
            group.require_known(arguments[1:], f"{before} {name}")
