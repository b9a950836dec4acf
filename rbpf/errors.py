"""Errors that a user can act on, and names as they may be shown."""


def printable(text: str) -> str:
    """A text, such as the name of a file, on one line: what cannot be shown is written as an escape."""
    shown = (c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode("ascii") for c in text)
    return "".join(shown)


class InputError(ValueError):
    """Something the user handed in is wrong: a file, a line, an argument or a model.

    The message is one sentence: the place, what was expected, what to do. The command line prints it and exits with code 2.
    """

    def __str__(self) -> str:
        return printable(super().__str__())
