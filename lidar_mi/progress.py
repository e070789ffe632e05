"""What is running, and how far it is: on a terminal, in a pipe and in a notebook."""

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


class progress:
    """A progress bar that says what is running; plain lines where there is no terminal."""

    def __init__(self, console: Console | None = None):
        # names of files may hold brackets and colons: they are no markup
        self.console = console or Console(stderr=True, markup=False, emoji=False)

    def __enter__(self):
        self.bars = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self.bars.start()
        self.task = self.bars.add_task("starting", total=None)
        self.last = None
        return self._notice

    def _notice(self, text: str, share: float | None) -> None:
        # a full bar would stop clock and spinner, and what comes next goes on
        self.bars.update(
            self.task,
            description=text,
            total=None if share is None else 1.0,
            completed=min(share or 0.0, 0.999),
        )
        if text != self.last and (text.startswith("warning: ") or not self.console.is_terminal):
            self.console.print(text, highlight=False, soft_wrap=True)
        self.last = text

    def __exit__(self, *_):
        self.bars.stop()
