"""The one exception a user should ever see for bad input."""


class InputError(ValueError):
    """Bad input: the message names the field or file, the value, and what is allowed.

    The command line prints the message as one line and exits with code 2.
    """
