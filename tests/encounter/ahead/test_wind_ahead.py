"""The wind ahead from vectors: with and without vortices, recorded and replayed.

Detects vortices that are counted twice or lost, a wind that jumps where a track ends, slabs that
are used before they are delivered, vectors that a replay does not have, an update that takes longer
than a flight allows.
"""

import numpy as np
import pytest
import torch
import xarray as xr

import lidar_mi as lm
from lidar_mi.aircraft.state import AircraftState
from lidar_mi.encounter.ahead.arrivals import arrivals_dataset
from lidar_mi.encounter.ahead.preview import WakeTracker
from lidar_mi.encounter.ahead.wind_ahead import WindAhead
from lidar_mi.encounter.lidar.vector_record import recorded_vectors, wind_of
from lidar_mi.errors import InputError
from lidar_mi.experiment.log import silent
from lidar_mi.experiment.truth.wake_along_path import wake_along_path
from lidar_mi.retrieval.along_path.vectors import slab_vectors
from lidar_mi.retrieval.vortices.model import widened
from lidar_mi.retrieval.vortices.model import wind as pair_wind
from lidar_mi.schema.reading import check
from tests.support.slab_winds import STRIDE, Slabs, calm, turbulent
from tests.support.synthetic_lidar import SyntheticLidar, encounter_keys

PERIOD, SPAN = 0.1, 28.9


class Air:
    """A wake, if any, and other air."""

    def __init__(self, wake, other):
        self._wake, self._other = wake, other

    def wind(self, x, y, z, time):
        found = np.array(self._other(x, y, z, time), float)
        if self._wake is not None:
            found += np.array(np.broadcast_arrays(*self._wake.wind(x, y, z, time)))
        return found


class WithVectors(SyntheticLidar):
    """Also delivers vectors, as means over windows with noise."""

    def __init__(self, wake, other=calm, noise=0.2, pairs=True, unseen=lambda n: False, **options):
        super().__init__(wake, latency=0.12, **options)
        self.air, self._pairs, self._unseen = Air(wake if pairs else None, other), pairs, unseen
        self._slabs = Slabs(self.air.wind, noise)

    def step(self, t, pose=None, expected=None):
        found = super().step(t, pose, expected)
        number = len(self.steps) - 1
        pair = found.pair if self._pairs else None
        seen = number > 0 and not self._unseen(number)
        wind = dataset(self._slabs.slab(found.x, found.time)) if seen else None
        return type(found)(found.time, found.delivered, found.x, wind, pair, (), found.seconds)


def dataset(vectors, **more):
    """As a retrieval delivers them."""
    fields = {}
    for k, name in enumerate("vw"):
        fields[name] = (("z", "y"), vectors.wind[k])
        fields[f"{name}_stderr"] = (("z", "y"), vectors.stderr[k])
    fields["flag"] = (("z", "y"), (~vectors.valid).astype(np.uint16))
    return xr.Dataset(fields, {"z": vectors.z, "y": vectors.y}, {"window": vectors.window, **more})


@pytest.fixture(scope="module")
def wake():
    return wake_along_path(check(encounter_keys(), "test"))


def tracked(lidar, until):
    tracker = WakeTracker(lidar, PERIOD, STRIDE, ahead=WindAhead(STRIDE, SPAN))
    for now in np.arange(0, until + 1e-9, 0.02):
        tracker.update(AircraftState(time=float(now), x=75 * float(now)))
    return tracker


def test_without_a_pair_there_is_a_preview(wake):
    other = turbulent(1.5, 200.0, 4)
    lidar = WithVectors(wake, other, pairs=False)
    tracker = tracked(lidar, 5.0)
    found = arrivals_dataset(tracker.arrivals, lidar.air)
    assert found.sizes["arrival"] > 30
    for name in "vw":
        off = found[f"arrival_{name}"] - found[f"arrival_{name}_true"]
        stderr = found[f"arrival_{name}_stderr"]
        truth = found[f"arrival_{name}_true"]
        assert np.sqrt((off**2).mean()) < 0.4 * np.sqrt((truth**2).mean())
        inside = (np.abs(off) < 2 * stderr).mean()
        assert 0.88 < inside
    # before a slab was delivered nothing was known
    assert not tracked(WithVectors(wake, other, pairs=False), 0.2).ahead


def test_latency_holds(wake):
    """The slab of the second scan at 0.1 s is there 0.12 s later."""
    lidar = WithVectors(wake, turbulent(1.5, 200.0, 4), pairs=False)
    assert not tracked(lidar, 0.20).ahead
    lidar = WithVectors(wake, turbulent(1.5, 200.0, 4), pairs=False)
    assert tracked(lidar, 0.24).ahead


def test_vortices_count_once(wake):
    """In air that is calm but for a wake the wind is that of the wake, cores included."""
    lidar = WithVectors(wake, noise=0.1)
    tracker = tracked(lidar, 1.6)
    y, z = np.meshgrid(np.linspace(-22, 22, 45), [0.0, 2.0])
    x = np.full(y.shape, 170.0)
    truth = lidar.air.wind(x, y, z, 170 / 75)[1:]
    found = np.stack(tracker.wind(x, y, z, 170 / 75)[1:])
    alone = WakeTracker(lidar, PERIOD, STRIDE)
    alone.slabs, alone._usable = tracker.slabs, tracker._usable
    tracks = np.stack(alone.wind(x, y, z, 170 / 75)[1:])
    strength = np.sqrt(np.mean(truth**2))
    error = np.sqrt(np.mean((found - truth) ** 2))
    # the track alone has its own errors
    assert error < np.sqrt(np.mean((tracks - truth) ** 2)) + 0.05 * strength
    assert error < 0.15 * strength


def test_turbulence_about_a_wake_is_known(wake):
    """The track alone does not know it."""
    lidar = WithVectors(wake, turbulent(1.0, 100.0, 8))
    tracker = tracked(lidar, 2.4)
    x, y = np.meshgrid(np.linspace(150, 240, 13), np.linspace(-14, 14, 15), indexing="ij")
    z = np.zeros(x.shape)
    truth = lidar.air.wind(x, y, z, x / 75)[2]
    with_air = tracker.wind(x, y, z, x / 75)[2]
    tracker.ahead = None
    alone = tracker.wind(x, y, z, x / 75)[2]
    errors = [np.sqrt(np.mean((one - truth) ** 2)) for one in (with_air, alone)]
    assert errors[0] < 0.7 * errors[1]


def test_a_lost_track_fades(wake):
    """In proportion to the distance beyond the track, to nothing in 150 m."""
    lidar = WithVectors(wake, noise=0.1, blind=lambda n: n > 10, unseen=lambda n: n > 10)
    tracker = tracked(lidar, 2.4)
    usable = [one.estimate.x for one in tracker.slabs if one.track and one.track.usable]
    end = max(usable) + 5 * STRIDE
    x = end + np.array([-1.0, 0.0, 37.5, 75.0, 112.5, 150.0, 300.0])
    y, z = np.full(x.shape, 5.0), np.zeros(x.shape)
    fading = tracker.wind(x, y, z, x / 75)[2]
    tracker.ahead = None
    alone = tracker.wind(x, y, z, x / 75)[2]
    np.testing.assert_allclose(fading, alone * [1, 1, 0.75, 0.5, 0.25, 0, 0], atol=0.15)
    assert np.abs(alone[:6]).min() > 0.2


def test_missing_slabs_cost_accuracy_alone(wake):
    other = turbulent(1.5, 200.0, 4)
    errors = {}
    for name, unseen in (("all", lambda n: False), ("half", lambda n: 8 < n % 20 < 15)):
        lidar = WithVectors(wake, other, pairs=False, unseen=unseen)
        tracker = tracked(lidar, 5.0)
        found = arrivals_dataset(tracker.arrivals, lidar.air)
        errors[name] = float(np.sqrt((found["arrival_w_stderr"] ** 2).mean()))
    assert 1.1 * errors["all"] < errors["half"] < 2 * errors["all"]


def test_widened_vortices_are_means():
    """Against a mean over points drawn from the Gaussian."""
    theta = torch.tensor([300.0, np.log(3.0), 5.0, 1.0, -300.0, np.log(2.0), -15.0, 0.0, 0.0, 0.0])
    random = np.random.default_rng(3)
    drawn_at = (7.0, 2.5) + 4.0 * random.normal(size=(400_000, 2))
    y, z = map(torch.as_tensor, drawn_at.T)
    drawn = pair_wind(theta.double(), y, z, "lamb_oseen")
    place = [torch.tensor([a], dtype=torch.float64) for a in (7.0, 2.5)]
    found = pair_wind(widened(theta.double(), 4.0), *place, "lamb_oseen")[:, 0]
    error = drawn.std(1) / np.sqrt(drawn.shape[1])
    assert (torch.abs(drawn.mean(1) - found) < 4 * error).all()


def test_vectors_are_recorded(wake):
    lidar = WithVectors(wake, turbulent(1.0, 100.0, 8), unseen=lambda n: n == 3)
    found = [lidar.step(0.1 * n) for n in range(6)]
    record = recorded_vectors(found)
    assert record.sizes["slab"] == 6
    for number, one in enumerate(found):
        again = wind_of(record, number)
        if one.wind is None:
            assert again is None
            continue
        before, after = slab_vectors(one.wind), slab_vectors(again)
        np.testing.assert_allclose(after.wind, before.wind, rtol=1e-6)
        np.testing.assert_allclose(after.stderr, before.stderr, rtol=1e-6)
        np.testing.assert_allclose(after.y, before.y)
        assert after.window == before.window


def flight(**control):
    keys = encounter_keys(
        air={"wake": False, "turbulence": {"level": "severe", "length": "80 m"}},
        control={"preview": "wind", **control},
    )
    return check(keys, "test")


@pytest.mark.slow
def test_flight_in_turbulence_rolls_less_and_is_replayed(tmp_path, monkeypatch):
    from lidar_mi.experiment.truth.flight_air import air_along_path

    monkeypatch.setattr("lidar_mi.encounter.report.draw_all", lambda *_: [])
    monkeypatch.setattr("lidar_mi.assessment.figures.encounter_film.RATE", 2)
    experiment = flight()
    lidar = WithVectors(wake_along_path(experiment), air_along_path(experiment).wind, pairs=False)
    first = lm.fly(experiment, tmp_path / "one", lidar=lidar, notice=silent)
    roll = {m: first.metrics[f"encounter.{m}.largest_roll"] for m in ("autopilot", "feedforward")}
    assert roll["feedforward"] < roll["autopilot"]
    assert first.metrics["encounter.wind_ahead.within_2_sigma"] > 0.85
    again = lm.fly(experiment, replay=tmp_path / "one", notice=silent)
    xr.testing.assert_allclose(again.series, first.series, rtol=1e-3, atol=1e-5)
    late = lm.fly(flight(latency="0.5 s"), replay=tmp_path / "one", notice=silent)
    np.testing.assert_allclose(late.track["vector_v"], first.track["vector_v"])


def test_what_a_preview_of_wind_needs():
    from lidar_mi.encounter.check import geometry

    assert not any("no vortices to track" in text for text in geometry(flight()))
    blind = geometry(flight(preview="pair"))
    assert any("expected true, or encounter.control.preview: wind" in text for text in blind)
    slab = Slabs(calm, 0.1).slab(100.0, 0.0)
    with pytest.raises(InputError, match=r"wind\.v_stderr: missing; expected v, w, their errors"):
        WindAhead(STRIDE, SPAN).add(100.0, 0.0, dataset(slab).drop_vars("v_stderr"), None, 0.0)
