"""The one exception a user should ever see for bad input, its message, what lies under others."""

from collections.abc import Iterator

LONGEST = 280
"""Characters of a message; with the program's name before it, it stays below 300."""


class InputError(ValueError):
    """Bad input: the message names the field or file, the value, and what is allowed.

    The message is one printable line of at most `LONGEST` characters, whatever was read into it.
    The command line prints it and exits with code 2.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))


def printable(text: str) -> str:
    r"""Text in which every character but the end of a line shows, others as escapes: ``\x1b``.

    A terminal would obey what a file may hold: colours, titles, moves of the cursor.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c == "\n" or c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )


def one_line(message: object, longest: int = LONGEST) -> str:
    """A message as one printable line; what is longer loses its middle."""
    # the ends are all that is kept of a text of megabytes, and blanks or escapes take more
    text = str(message)
    if len(text) > 20 * longest:
        text = f"{text[: 10 * longest]} ... {text[-10 * longest :]}"
    text = printable(" ".join(text.split()))
    if len(text) <= longest:
        return text
    # the beginning says where, the end what is allowed
    tail = longest // 3
    return f"{text[: longest - tail - 5].rstrip()} ... {text[-tail:].lstrip()}"


class Stopped(BaseException):
    """A signal, of this number, asks the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception, the one it came from, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def is_interrupt(error: BaseException) -> bool:
    """Whether someone stopped the program.

    Libraries put exceptions of their own in the place of ``KeyboardInterrupt``.
    """
    return any(isinstance(cause, KeyboardInterrupt | Stopped) for cause in causes(error))


def notes(error: BaseException) -> list[str]:
    """What was added to an exception and to those it came from, each note once."""
    return list(
        dict.fromkeys(note for cause in causes(error) for note in getattr(cause, "__notes__", ()))
    )
