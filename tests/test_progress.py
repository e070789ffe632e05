"""What is shown while something runs. Unit tier.

Detects: a clock that stops before the end, a bar that stays behind, steps said twice in a pipe or
not at all, a warning that vanishes, a name taken for markup, and messages to a notebook's page that
are broken or too many.
"""

import io
import re
import time
from types import SimpleNamespace

import pytest
from rich.console import Console

from lidar_mi.progress import progress

STEPS = (
    ("rendering [scan] 1 of 2 :cloud:", 0.0),
    ("rendering [scan] 1 of 2 :cloud:", 0.5),
    ("warning: <few> vectors", None),
    ("retrieving", None),
)


def shown(terminal: bool, pause: float = 0.0) -> str:
    file = io.StringIO()
    console = Console(
        file=file, force_terminal=terminal, width=100, markup=False, emoji=False, color_system=None
    )
    with progress(console) as notice:
        notice("rendering", 1.0)
        time.sleep(pause)
        for step in STEPS:
            notice(*step)
        time.sleep(pause / 4)
    return file.getvalue()


def test_a_pipe_gets_every_step_as_one_line():
    assert shown(terminal=False).splitlines() == [
        "rendering",
        STEPS[0][0],
        "warning: <few> vectors",
        "retrieving",
    ]


def test_a_terminal_gets_a_bar_with_a_running_clock():
    """After a step that was done to the end, too."""
    output = shown(terminal=True, pause=1.1)
    assert re.search(r"retrieving .* 0:00:01", output)
    # the bar is wiped, the warning is a line of its own
    assert output.endswith("\x1b[2K") or "\x1b[2K" in output[-20:]
    assert "\nwarning: <few> vectors" in output.replace("\r", "\n").replace("\x1b[2K", "")


class Handle:
    def __init__(self, page):
        self.page = page

    def update(self, shown):
        self.page.append(shown.data)


def test_a_notebook_gets_few_messages_and_keeps_warnings(monkeypatch, capsys):
    display = pytest.importorskip("IPython.display", reason="IPython is not installed")
    page = []
    monkeypatch.setattr(display, "display", lambda *_, **__: Handle(page))
    console = SimpleNamespace(is_jupyter=True)
    with progress(console) as notice:
        for step in STEPS:
            notice(*step)
        for fraction in range(1000):
            notice("retrieving", fraction / 1000)
    assert page[0].startswith('<progress value="0.000">') and "[scan]" in page[0]
    assert "&lt;few&gt;" in page[1] and page[-1] == ""
    assert len(page) < 20
    assert capsys.readouterr().out == "warning: <few> vectors\n"


@pytest.mark.parametrize("terminal", [True, False])
def test_an_exception_passes_through(terminal):
    console = Console(file=io.StringIO(), force_terminal=terminal)
    with pytest.raises(KeyboardInterrupt), progress(console):
        raise KeyboardInterrupt
