"""The benchmark of the estimator's latency: its slabs, and a row for every part."""

import numpy as np
import pytest

from benchmarks import realtime


def test_the_pair_drifts_from_slab_to_slab():
    first, last = (realtime.slab(k, 20, 219, 139).vortices for k in (0, 20))
    assert abs(last[0].circulation) < abs(first[0].circulation)
    assert last[0].z < first[0].z and last[0].y > first[0].y


@pytest.mark.slow
def test_every_part_has_its_latency(monkeypatch):
    monkeypatch.setattr(realtime, "SLABS_A_TURN", 4)
    monkeypatch.setattr(realtime, "COLD", 2)
    monkeypatch.setattr(realtime, "SEPARATION", 28.0)
    found = realtime.compare(1, 140, 110)
    names = {line.quantity for line in found.rows}
    for part in realtime.PARTS:
        part = part.replace("_", " ")
        assert {f"{part}, median", f"{part}, 99 %"} <= names
    total = next(line for line in found.rows if line.quantity == "total, median")
    assert total.ratio > 2
    assert all(np.isfinite(line.ours) for line in found.rows)
    assert "100%" in found.notes[0]
    (lines,) = (line for line in found.rows if line.quantity == "line error")
    # 20 pulses: a quarter of the paper's 0.5 m/s
    assert lines.ours < 0.12
