"""When slabs are estimated: work before and after the second image, waiting, skipped slabs.

Detects time that is not charged, a backlog that is forgotten, a queue that grows without limit,
work on an image that is not there yet.
"""

import pytest

import lidar_mi as lm
from lidar_mi.encounter.lidar.computer import Cores
from lidar_mi.encounter.lidar.estimate import SKIPPED
from lidar_mi.encounter.lidar.estimator import SlabEstimate
from lidar_mi.retrieval.vortices.acceptance import no_fit
from lidar_mi.schema.reading import check
from tests.support.encounters import small_encounter
from tests.support.synthetic_lidar import encounter_keys

PERIOD = 0.1
PARTS = {"lines": 0.03, "vortices_before": 0.01, "wind_before": 0.04}
PARTS |= {"vortices": 0.06, "wind": 0.03, "combination": 0.02}


def late(seconds, busy=(-1.0, -1.0)):
    """Work after the second image at 1 s; the cores are busy so long after the first one."""
    cores = Cores(*(1.0 - PERIOD + one for one in busy)).after(1.0, PERIOD, PARTS | seconds)
    return tuple(one - 1.0 for one in cores)


def test_what_is_not_finished_at_the_second_image_is_late():
    """Each core finishes the last slab, then works ahead; lines come half a period before."""
    # both have time: the lines, of 0.07 to 0.1 s, have just been read
    assert late({}, (0.06, 0.05)) == pytest.approx((0.06, 0.05))
    assert late({"lines": 0.055}) == pytest.approx((0.065, 0.05))
    # 0.08 s of the last slab's wind and 0.04 s before: 0.02 s late
    assert late({}, (0.06, 0.08)) == pytest.approx((0.06, 0.07))
    # nothing is combined before its lines are read
    assert late({"lines": 0.1}) == pytest.approx((0.11, 0.07))


def test_a_backlog_is_kept_and_slabs_are_skipped():
    """Slabs of 0.25 s, ten a second: taken when the core is free before the next one comes."""
    cores, taken = Cores(), []
    for number in range(12):
        takes, _ = cores.take(number * PERIOD, PERIOD)
        if takes:
            cores = cores.after(number * PERIOD, PERIOD, {"vortices": 0.25})
            taken.append((number, cores.vortices))
    # begun at 0, 0.25, 0.5, 0.75 and 1.0 s, with the newest slab then
    assert [number for number, _ in taken] == [0, 2, 4, 7, 9, 11][: len(taken)]
    assert [end for _, end in taken][:4] == pytest.approx([0.25, 0.5, 0.75, 1.0])
    assert cores.wind < 0  # the other core did nothing


def test_measured_time_is_charged(monkeypatch):
    """Fits of 0.14 s on a computer of half the speed: 0.28 s each, most slabs are skipped."""
    lidar = lm.VirtualLidar(small_encounter(control={"computing_factor": 2}))
    asked = []

    def pair_of(*_, take=(True, True), **__):
        asked.append(take[0])
        pair = no_fit("lamb_oseen", "none" if take[0] else SKIPPED)
        return SlabEstimate(None, pair, {"vortices": 0.14} if take[0] else {})

    monkeypatch.setattr(lidar._estimator, "pair_of", pair_of)
    found = [lidar.step(0.1 * number) for number in range(8)][1:]
    # the first call loads what a program loads
    assert asked == [True, True, False, True, False, False, True, False]
    skipped = [f"vortices: {SKIPPED}" in one.flags for one in found]
    assert skipped == [not one for one in asked[1:]]
    delivered = [one.delivered for one in found if f"vortices: {SKIPPED}" not in one.flags]
    assert delivered == pytest.approx([0.38, 0.66, 0.94])
    # a step that is repeated is not charged twice
    asked.clear()
    assert lidar.step(0.7).delivered == pytest.approx(0.94) and asked == [False]


def test_latencies_are_computed_or_fixed():
    for value, fixed, usual in ((None, 0.0, 0.1), ("0.2 s", 0.2, 0.2)):
        encounter = check(encounter_keys(control={"latency": value}), "test").encounter
        assert (encounter.fixed_latency, encounter.usual_latency) == (fixed, usual)
