"""The figure of poses by the rules of all figures.

Detects: a panel without data, arrows of no length or without a scale.
"""

import numpy as np
import pytest

from lidar_mi.assessment.figures.pointing import draw_all
from lidar_mi.assessment.metrics.pointing import ScanPointing
from lidar_mi.experiment.log import Log
from tests.support import figure_rules

Y, Z = np.arange(-20.0, 21.0), np.arange(-10.0, 11.0)
NODES = np.stack(np.meshgrid(Y[::-1], Z[::-1]), -1).reshape(-1, 2)
TURN = 1e-3 * NODES[:, ::-1] * [-1, 1]


@pytest.mark.parametrize(
    ("errors", "moved", "words"),
    [
        ([0, 0], 0.0, "Time of each beam"),
        ([TURN, -TURN], 0.0, "The wind that this alone"),
        # what both scans have in common is no wind
        ([TURN, TURN], 0.0, "The wind that this alone"),
        ([TURN, -TURN], 0.1, "How far beams are"),
    ],
)
def test_poses(tmp_path, errors, moved, words):
    shape = 2, len(NODES), 2
    errors = np.stack([np.broadcast_to(one, shape[1:]) for one in errors])
    time = np.broadcast_to(np.linspace(-0.05, 0.05, len(NODES)), shape[:2])
    places = np.broadcast_to(NODES + moved, shape)
    with figure_rules.judged_figures() as found:
        drawn = draw_all(tmp_path, ScanPointing(Y, Z, 0.2, time, places, errors), Log())
    assert found == {"fig24_scan_time": []} and words in drawn[0].caption
