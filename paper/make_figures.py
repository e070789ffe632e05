"""Draw the figures of the paper: one to two minutes on two cores.

Usage: ``python paper/make_figures.py``.
"""

import shutil
import tempfile
from pathlib import Path

import lidar_mi as lm

PAPER = Path(__file__).parent

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        lm.run(lm.load_experiment("wake_backscatter"), f"{folder}/wake")
        lm.fly(lm.load_experiment("encounter"), f"{folder}/flight")
        for figure, name in (
            ("wake/figures/fig00_overview.png", "figure_wake.png"),
            ("flight/figures/fig30_roll.png", "figure_encounter.png"),
        ):
            shutil.copy(Path(folder, figure), PAPER / name)
            print(PAPER / name)
