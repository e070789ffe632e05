"""The benchmark of the estimator's latency: its slabs."""

from benchmarks import realtime


def test_the_pair_drifts_from_slab_to_slab():
    first, last = (realtime.slab(k, 20, 219, 139).vortices for k in (0, 20))
    assert abs(last[0].circulation) < abs(first[0].circulation)
    assert last[0].z < first[0].z and last[0].y > first[0].y
