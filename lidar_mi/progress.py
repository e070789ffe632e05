"""What is running, and how far it is: on a terminal, in a pipe and in a notebook."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from html import escape
from importlib import import_module
from typing import Any

from rich.console import Console
from rich.text import Text

from lidar_mi.errors import printable

Notice = Callable[[str, float | None], None]
"""Called with what is running and how far it is (0 to 1, None: unknown)."""

# seconds between two pictures of a bar in a notebook, each of which is a message to the browser
_NOTEBOOK_INTERVAL = 0.2


class Terminal(Console):
    """A console for text that may hold names from files and folders.

    Brackets and colons in it are no markup; what a terminal would obey, or has no character for,
    shows as an escape.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of whatever is printed: lines, titles and cells of tables."""
        shown = printable(text).encode(self.encoding, "backslashreplace").decode(self.encoding)
        return super().render_str(shown, **options)


def progress(console: Console | None = None) -> AbstractContextManager[Notice]:
    """Show what is running while the context lasts.

    A bar with a clock on a terminal and in a notebook, gone at the end; a line for every step where
    the output is a file or a pipe. Warnings, which are texts that begin so, stay.
    """
    console = console or Terminal(stderr=True)
    if console.is_jupyter:
        return _in_notebook()
    return _on_terminal(console) if console.is_terminal else _as_lines(console)


@contextmanager
def _as_lines(console: Console) -> Iterator[Notice]:
    last = None

    def notice(text: str, fraction: float | None) -> None:
        nonlocal last
        if text != last:
            console.print(text, highlight=False, soft_wrap=True)
        last = text

    yield notice


@contextmanager
def _on_terminal(console: Console) -> Iterator[Notice]:
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    text_column = TextColumn("{task.description}", markup=False)
    columns = (SpinnerColumn(), text_column, BarColumn(), TimeElapsedColumn())
    last = None
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("starting", total=None)

        def notice(text: str, fraction: float | None) -> None:
            nonlocal last
            # a full bar would stop clock and spinner, and what comes next goes on
            total, completed = (None, 0.0) if fraction is None else (1.0, min(fraction, 0.999))
            bars.update(task, description=printable(text), total=total, completed=completed)
            if text != last and _is_warning(text):
                console.print(text, highlight=False, soft_wrap=True)
            last = text

        yield notice


@contextmanager
def _in_notebook() -> Iterator[Notice]:
    ipython: Any = import_module("IPython.display")  # it states no types
    start = shown = time.monotonic()
    last = None
    bar = ipython.display(ipython.HTML(""), display_id=True)

    def notice(text: str, fraction: float | None) -> None:
        nonlocal shown, last
        now = time.monotonic()
        if text != last and _is_warning(text):
            print(printable(text))
        if text != last or now - shown > _NOTEBOOK_INTERVAL:
            value = "" if fraction is None else f' value="{fraction:.3f}"'
            clock = f"{int(now - start) // 60}:{int(now - start) % 60:02d}"
            bar.update(ipython.HTML(f"<progress{value}></progress> {clock} {escape(text)}"))
            shown = now
        last = text

    try:
        yield notice
    finally:
        bar.update(ipython.HTML(""))


def without_warnings(notice: Notice) -> Notice:
    """A notice for steps whose warnings are shown with their results."""

    def shown(text: str, fraction: float | None) -> None:
        if not _is_warning(text):
            notice(text, fraction)

    return shown


def _is_warning(text: str) -> bool:
    return text.startswith("warning: ")
