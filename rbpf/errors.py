"""Errors that a user can act on."""


class InputError(ValueError):
    """Something the user handed in is wrong: a file, a line, an argument or a model.

    The message is one sentence that names the place, says what was expected and what to do.
    The command line prints it and exits with code 2, without a traceback.
    """
