"""The one exception a user should ever see for bad input, and what lies under others."""

from collections.abc import Iterator


class InputError(ValueError):
    """Bad input: the message names the field or file, the value, and what is allowed.

    The command line prints the message as one line and exits with code 2.
    """


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception, the one it came from, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def is_interrupt(error: BaseException) -> bool:
    """Whether someone stopped the program.

    Libraries put exceptions of their own in the place of ``KeyboardInterrupt``.
    """
    return any(isinstance(cause, KeyboardInterrupt) for cause in causes(error))
