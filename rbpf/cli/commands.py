"""A group of commands that checks names and options itself: the parser's error messages are long, or off the point."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import redirect_stderr
from dataclasses import dataclass, is_dataclass
from difflib import get_close_matches
from io import StringIO
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro

from rbpf.errors import InputError
from rbpf.ranges import SettingError, check_ranges


@dataclass(frozen=True, eq=False)
class Commands:
    """A group of commands."""

    help: str  #: its first line is shown in the group above.
    #: by name, further groups, and dataclasses whose fields are options, and which run the command when called.
    kinds: "Mapping[str, Commands | type[Any]]"
    first: Callable[[], object] = lambda: None  #: called before each command.

    def call(self, arguments: list[str], before: str) -> None:
        """Calls the command named by the arguments; `before` are the preceding words.

        For a group, or its help, the parser lists the commands.

        Raises InputError: there is no such command or option, or a value is missing or out of its range.
        """
        if not arguments or arguments[0].startswith("-"):
            _parse(self._parsed(), arguments, before, self.help)
            return
        name = arguments[0].replace("_", "-")
        if name not in self.kinds:
            raise InputError(f"there is no command `{before} {arguments[0]}`: {_nearest(name, self.kinds)}")
        kind, before, arguments = self.kinds[name], f"{before} {name}", arguments[1:]
        if isinstance(kind, Commands):
            kind.call(arguments, before)
            return
        options = ["--help", *_options(kind)]
        for word in arguments:
            option = word.partition("=")[0].replace("_", "-")
            if len(option) > 2 and option.startswith("--") and option not in options:
                raise InputError(f"`{before}` has no option {option}: {_nearest(option, options)}")
        command = _parse(kind, arguments, before)
        for name, value in vars(command).items():
            if isinstance(value, tuple) and not value and (option := f"--{name.replace('_', '-')}") in arguments:
                raise InputError(f"{option} is named without a value")
        try:
            for options_of in (command, *filter(is_dataclass, vars(command).values())):
                check_ranges(options_of)
        except SettingError as error:
            raise InputError(f"--{error.name.replace('_', '-')} {error.words}") from error
        self.first()
        command()

    def _parsed(self) -> Any:
        """The group's type for the parser, with a help text, for which it would otherwise read the source of `typing`."""
        parts = []
        for name, kind in self.kinds.items():
            if isinstance(kind, Commands):
                first = kind.help.partition("\n")[0]
                group = tyro.conf.subcommand(name, description=first, constructor_factory=kind._parsed)
                parts.append(Annotated[Any, group])
            else:
                parts.append(Annotated[Any, tyro.conf.subcommand(name, constructor=kind)])
        return Annotated[Union[tuple(parts)], tyro.conf.arg(help="")]  # noqa: UP007


def _parse(kind: Any, arguments: list[str], before: str, description: str | None = None) -> Any:
    """What the parser makes of the arguments; its errors, boxes of several lines, become a sentence."""
    try:
        with redirect_stderr(StringIO()) as box:
            return tyro.cli(kind, prog=before, description=description, args=arguments)
    except SystemExit as ended:
        if not ended.code:
            raise
    plain = re.sub(r"\x1b\[[\d;]*m|[│|─╭╮╰╯+]|-{3,}", "", box.getvalue()).partition("\n")[2]
    said = " ".join(re.split(r"\n\s*\n", plain)[0].split()).rstrip(".").replace(". Expected", ", expected")
    said = re.sub(r"Error parsing (\S+): no type .*\{None\}(\w+) could .*\['(.*)'\]", r"\1 takes \2, got '\3'", said)
    said = re.sub(r"'None', |, 'None'", "", said).replace(" takes INT,", " takes a whole number,")
    raise InputError(f"{said}; `{before} --help` says more")


def _options(kind: Any) -> Iterator[str]:
    """The options of a dataclass, and of its groups, as given on the command line."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if is_dataclass(bare := get_args(hint)[0] if get_origin(hint) is Annotated else hint):
            yield from _options(bare)
        elif tyro.conf.Positional not in getattr(hint, "__metadata__", ()):
            option = name.replace("_", "-")
            yield from (f"--{option}", f"--no-{option}") if hint is bool else (f"--{option}",)


def _nearest(name: str, names: Iterable[str]) -> str:
    """A suggestion, or else all names."""
    close = get_close_matches(name, names, 1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(names)}"
