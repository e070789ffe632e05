"""The slices of docs/guide/measured_wakes.md have the vortices that their script puts there.

Detects: an example that states another pulse than its script averages over.
"""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "measured_wakes.md"


@pytest.mark.slow
def test_the_example_finds_its_vortices(tmp_path, monkeypatch):
    """16 numbers within 3.5 standard errors: exceeded by chance in 1 %."""
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    names: dict = {}
    for script in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(script, names)
    found = names["found"]
    seconds = (found["time"].values - np.datetime64("1970-01-01")) / np.timedelta64(1, "s")
    truth = {
        "y": [580, 620] + 2 * seconds[:, None],
        "z": 90 - 350 / (2 * np.pi * 40) * seconds[:, None],
        "circulation": np.array([-350, 350]),
        "core_radius": 3.0,
    }
    assert (found["flag"] == 0).all()
    for name, expected in truth.items():
        off = (found[name] - expected) / found[f"{name}_stderr"]
        assert (np.abs(off) < 3.5).all(), f"{name}: {off.values}"
    # the command states what the script in Python does
    stated = [set(re.findall(rf"{n}[ =]'?(\d+)", text)) for n in ("pulse.length", "gate.length")]
    assert stated == [{"15"}, {"15"}]
