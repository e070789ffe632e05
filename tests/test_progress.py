"""What a terminal is shown while something runs. Detects a clock that stops before the end."""

import io

from rich.console import Console

from lidar_mi.progress import progress


def test_the_clock_goes_on_after_a_step_is_done():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    bar = progress(console)
    with bar as notice:
        task = bar.bars.tasks[0]
        notice("rendering", 1.0)
        assert not task.finished and task.completed > 0.99
        before = task.elapsed
        notice("retrieving", None)
        assert task.description == "retrieving" and task.completed == 0
        assert task.elapsed > before and task.finished_time is None
