"""Lines of a coherent lidar from the truth to vortices and winds. Physics tier.

Detects: a lidar on the wrong side of the flight, a heading or an azimuth that turns the wrong way,
wind of the wrong sign, lines of another time, an echo that is not that of the air, truth and fit
in different planes, vortices that turn the wrong way, files that are not read again.
"""

import math

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.assessment.figures.coherent import draw_slices
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.run import prepare
from lidar_mi.experiment.stages.coherent_lines import (
    coherent_lines,
    line_scan,
    passing_air,
    ring_fraction,
)
from lidar_mi.experiment.stages.line_retrieval import line_vortices, line_winds
from tests.support import figure_rules
from tests.support.experiments import check

QUIET = {"signal": {"cnr": 30, "profile": "constant"}}
PAIR = {"vortex_pair": {"circulation": 400, "separation": "40 m"}}


def experiment(doppler=None, wake=PAIR, **more):
    data = {"name": "lines", "doppler": {"kind": "coherent"} | (doppler or {})}
    return check(data | ({} if wake is None else {"wake": wake}) | more)


def measured(given):
    air = call(passing_air, given)
    return air, call(coherent_lines, given, passing_air=air)


SMALL = {
    "laser": {"first_gate": "100 m", "gates": 60, "gate_spacing": "5 m", "gate_length": "10 m"}
    | {"pulse_length": "10 m"},
    "scan": {"count": 1, "elevations": ["0 deg", "30 deg"], "rate": "10 deg/s"},
    "position": ["0 m", "200 m", "2 m"],
    "passage": {"height": "60 m"},
} | QUIET


@pytest.mark.parametrize(
    ("heading", "azimuth", "y"), [(0, 90, 200), (90, 180, 200), (0, -90, -200), (300, 30, 200)]
)
def test_the_wake_is_where_lines_turn_over(heading, azimuth, y):
    """Seen from its left or right side, whatever the heading, and turning as it does.

    Through the middle of a vortex the radial velocity changes its sign; above that which turns
    from distance to height, air moves to the lidar.
    """
    changes = {
        "scan": SMALL["scan"]
        | {"azimuth": f"{azimuth} deg", "rate": "0.1 deg/s"}
        | {"accumulation": "2 s", "repeat": None, "elevations": ["10 deg", "25 deg"]},
        "position": ["0 m", f"{y} m", "2 m"],
        "passage": {"height": "60 m", "heading": f"{heading} deg"},
    }
    given = experiment(SMALL | changes)
    # no time passes for the wake: a line of sight sees it where it is at its start
    air = call(passing_air, given)
    still = air.vortices(0.0)
    object.__setattr__(air.wake, "vortices", lambda time: still)
    object.__setattr__(air.wake, "_path", lambda t: np.repeat(START[:, None], np.size(t), 1))
    lines = call(coherent_lines, given, passing_air=air)
    for k, side in enumerate(("port", "starboard")):
        place, height, circulation = (
            float(lines[f"vortex_{name}"].sel(vortex=side)[0]) for name in ("y", "z", "circulation")
        )
        assert height == pytest.approx(58)
        assert place == pytest.approx(200 + (-20 if (k == 0) == (y > 0) else 20))
        angle, distance = math.degrees(math.atan2(height, place)), math.hypot(place, height)
        column = lines["radial_velocity_true"].sel(range=distance, method="nearest")
        below, above = (
            float(column[np.abs(lines["elevation"].values - angle - step).argmin()])
            for step in (-1.0, 1.0)
        )
        assert below * above < 0 and (below > 0) == (circulation > 0)


START = np.array([20.0, -20.0, 60.0, 60.0])


def test_lines_are_at_their_times():
    """Up and down in turn, from one start to the next after 5 s; stare, dbs and ppi the same."""
    scan = experiment({"scan": SMALL["scan"] | {"count": 3, "repeat": "5 s"}}).doppler.scan
    lines = line_scan(scan)
    starts = [lines.time[lines.sweep == k][0] for k in range(3)]
    np.testing.assert_allclose(np.diff(starts), 5.0)
    assert lines.elevation[lines.sweep == 1][0] > lines.elevation[lines.sweep == 1][-1]
    for kind in ("stare", "dbs", "ppi"):
        given = {"kind": kind, "count": 4, "accumulation": "0.5 s", "repeat": "20 s"}
        found = line_scan(
            experiment({"scan": given | {"rate": "30 deg/s"}}, wake=None).doppler.scan
        )
        first = found.time[:: len(found.time) // 4]
        np.testing.assert_allclose(np.diff(first), 20.0)


def test_velocities_are_those_of_the_wind_with_bias():
    """Uniform wind along the flight (heading east) and to its left (north)."""
    doppler = {
        "scan": {"kind": "ppi", "elevation": "0 deg", "rate": "1 deg/s", "count": 1}
        | {"accumulation": "1 s", "repeat": None},
        "passage": {"heading": "90 deg"},
        "air": {"wind": ["5 m/s", "2 m/s"]},
        "bias": "0.3 m/s",
    }
    _, lines = measured(experiment(doppler | QUIET, wake=None))
    azimuth = np.deg2rad(lines["azimuth"].values)
    expected = 5 * np.sin(azimuth) + 2 * np.cos(azimuth)
    true = lines["radial_velocity_true"].values
    np.testing.assert_allclose(true, np.broadcast_to(expected[:, None], true.shape), atol=2e-4)
    noise = lines["radial_velocity"].values - true - 0.3
    assert abs(noise.mean()) < 4 * noise.std() / np.sqrt(noise.size / 3)


def test_the_echo_falls_as_the_lidar_equation():
    """With the square of the range and the transmittance there and back; the stated ratio at it."""
    doppler = {"scan": {"kind": "stare", "count": 2}, "signal": {"cnr": 0, "range": "700 m"}}
    given = experiment(doppler, wake=PAIR | {"extinction": {"background": "1 / km"}})
    _, lines = measured(given)
    ranges, ratio = lines["range"].values, lines["snr"].values[0]
    expected = (700 / ranges) ** 2 * np.exp(-2e-3 * (ranges - 700))
    # the mean over a gate of a curve that bends: by half of its second derivative
    np.testing.assert_allclose(ratio, expected, rtol=0.01)
    assert ratio[30] == pytest.approx(expected[30], rel=5e-3)


@pytest.mark.slow
def test_vortices_come_back_from_the_lines():
    """A pair in calm air, to 20 cm and 2 %, on its true side; there is hardly any noise."""
    given = experiment(SMALL)
    air, lines = measured(given)
    found = call(line_vortices, given, coherent_lines=lines, passing_air=air)
    assert int(found["flag"][0]) == 0
    for name in "yz":
        assert np.abs((found[name] - found[f"{name}_true"]).values).max() < 0.2
    assert (np.abs(found["circulation_5_15"] / found["circulation_5_15_true"] - 1) < 0.02).all()
    assert (found["circulation_5_15_true"].values[0] < 0).tolist() == [True, False]


def test_winds_come_back_from_the_lines():
    scan = {"kind": "ppi", "rate": "30 deg/s", "accumulation": "0.5 s", "count": 2}
    scan |= {"repeat": "20 s"}
    doppler = {
        "laser": {"first_gate": "100 m", "gates": 20, "gate_spacing": "30 m"},
        "signal": {"cnr": 0, "profile": "constant"},
        "air": {"wind": ["5 m/s", "2 m/s"]},
    }
    given = experiment(doppler | {"scan": scan}, wake=None)
    air, lines = measured(given)
    found = call(line_winds, given, coherent_lines=lines, passing_air=air)
    # the flight is to the north: along it is v, to its left is west
    for name, expected in (("u", -2.0), ("v", 5.0), ("w", 0.0)):
        np.testing.assert_allclose(found[f"{name}_true"], expected, atol=1e-12)
        # a beam that moves by 15 degrees averages over them
        smear = 1 if name == "w" else np.sinc(np.deg2rad(15) / 2 / np.pi)
        np.testing.assert_allclose(found[name], expected * smear, atol=0.1)
    together = experiment(doppler | {"scan": scan, "interval": "60 s"}, wake=None)
    one = call(line_winds, together, coherent_lines=lines, passing_air=air)
    assert one.sizes["time"] == 1 and found.sizes["time"] == 2


def test_circulation_over_rings():
    """Of a thin core all of it; of a Lamb-Oseen vortex by quadrature of the closed form."""
    assert ring_fraction(np.array(1e-3), "lamb_oseen") == pytest.approx(1)
    r = np.linspace(5, 15, 20001)
    expected = np.mean(1 - np.exp(-1.2564312 * (r / 4) ** 2))
    assert ring_fraction(np.array(4.0), "lamb_oseen") == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
def test_a_run_writes_files_that_are_read_again(tmp_path):
    given = experiment(SMALL)
    done = lm.run(given, tmp_path / "run")
    lines = lm.read_lines_of_sight(tmp_path / "run" / "lines_of_sight.nc")
    np.testing.assert_allclose(
        lines["radial_velocity"], done.lines["radial_velocity"], atol=2e-6, rtol=1e-6
    )
    np.testing.assert_allclose(lines["elevation"], done.lines["elevation"])
    assert lines.attrs["scan"] == "rhi"
    assert (lines.attrs["gate_length"], lines.attrs["pulse_length"]) == pytest.approx((10, 10))
    assert "Coherent lidar, 1 vertical slice" in (tmp_path / "run" / "report.html").read_text()
    assert {path.name for path in (tmp_path / "run" / "figures").iterdir()} == {
        "fig30_slices.png",
        "fig31_vortex_track.png",
        "fig32_vortex_errors.png",
    }


@pytest.mark.parametrize(
    ("doppler", "wake", "message"),
    [
        ({"scan": {"azimuth": "1 deg"}}, PAIR, "doppler.scan.azimuth: 1 deg is along the flight"),
        ({"position": ["0 m", "-700 m", "2 m"]}, PAIR, "doppler.position: the wake begins -700"),
        ({"laser": {"gates": 10}}, PAIR, "doppler.position: the wake begins 700 m ahead"),
        (
            {"passage": {"age": "10 s"}},
            {"file": "wake_slab_40s.nc", "time": "40 s"},
            "doppler.passage.age: 10 is not allowed with wake.file",
        ),
        ({}, {"file": "wake_volume_40s.nc"}, "wake.x: missing; wake_volume_40s.nc has 20 planes"),
        (
            {"laser": {"gates": 10000, "pulse_rate": "1 kHz"}, "scan": {"accumulation": "1 ms"}},
            PAIR,
            "doppler.scan: 4.8e+08 cells are not allowed",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused(doppler, wake, message):
    with pytest.raises(InputError) as error:
        prepare(experiment(doppler, wake))
    assert str(error.value).startswith(message)


@pytest.mark.slow
@pytest.mark.parametrize(("exhaust", "flagged"), [("tracer", True), (None, False)])
def test_slices_of_an_uneven_echo_are_flagged(exhaust, flagged, tmp_path):
    """Exhaust in the cores hides the air around them from gates of 30 m: no error bar says so."""
    wake = {"file": "wake_slab_40s.nc", "time": "40 s", "extinction": {"tracer": exhaust}}
    wake["extinction"]["aerosol"] = None
    scan = {"count": 1, "elevations": ["3 deg", "13 deg"], "rate": "4 deg/s"}
    given = experiment({"scan": scan, "passage": {"height": "100 m"}}, wake)
    air, lines = measured(given)
    found = call(line_vortices, given, coherent_lines=lines, passing_air=air)
    meanings, masks = (
        found["flag"].attrs["flag_meanings"].split(),
        found["flag"].attrs["flag_masks"],
    )
    mask = int(masks[meanings.index("uneven_echo")])
    assert bool(int(found["flag"][0]) & mask) == flagged
    assert len(meanings) == len(masks) == len(set(masks.tolist()))
    # flagged slices have no errors to show
    with figure_rules.judged_figures() as figures:
        draw_slices(tmp_path, lines, found, Log())
    assert len(figures) == 3 - flagged and not any(figures.values()), figures
