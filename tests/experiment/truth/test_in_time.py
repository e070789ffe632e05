"""The air while a scan lasts, and its image.

Detects: 0.02 nodes of a pattern's place at any time of a scan, in the air and in the image; a sign
of time; air of a scan's reference time that is not the truth; molecules that move.
"""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import lidar_mi as lm
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.truth import in_time as truth_in_time
from lidar_mi.experiment.truth.extinction import Truth, make_truth
from lidar_mi.experiment.truth.flows import flows_of
from lidar_mi.experiment.truth.in_time import air_in_time, state_times
from lidar_mi.instrument.beams import Beams
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.phase import ScatteringAir, molecules
from lidar_mi.rendering.settings import RenderSettings

SPACING, DT = 0.5, 0.1
Y, Z = SPACING * np.arange(-60, 61), SPACING * np.arange(-40, 41)
U = np.array([10.0, -7.0])  # m/s along y and z
WAVE = 8 * SPACING
MEAN = 1e-3


def field(values):
    shape = (1, len(Y), len(Z))
    values = np.broadcast_to(np.asarray(values, float), shape)
    return xr.DataArray(values, {"x": [501.25], "y": Y, "z": Z}, ("x", "y", "z"))


def sinusoid(time, wave=WAVE):
    """Waves along y and along z, carried by the wind."""
    k = 2 * np.pi / wave
    across = np.cos(k * (Y - U[0] * time))[:, None] + np.cos(k * (Z - U[1] * time))
    return field(MEAN * (1 + 0.45 * across))


@pytest.fixture(scope="module")
def experiment():
    loaded = lm.load_experiment("wake_backscatter", platform={"dt": DT}, scan={"air": "moving"})
    assert loaded.wake.spacing == SPACING
    return loaded


@pytest.fixture
def carried():
    """Truth and flows of a uniform wind."""
    wind = {"u": field(0), "v": field(U[0]), "w": field(U[1])}
    extinction = (sinusoid(0), sinusoid(DT))
    return Truth(extinction, extinction, xr.Dataset()), (xr.Dataset(wind), None)


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("nodes", [4, 8])
def test_a_carried_sinusoid_at_any_time(experiment, carried, which, nodes):
    """Linear between states, as it is rendered; the shortest wave of a grid has 4 nodes."""
    truth, flows = carried
    wave = nodes * SPACING
    extinction = (sinusoid(0, wave), sinusoid(DT, wave))
    air = call(
        air_in_time,
        experiment,
        truth=replace(truth, extinction=extinction),
        flows=flows,
        which=which,
        times=np.array([-0.06, 0.06]),
    )
    assert air["time"].values[[0, -1]] == pytest.approx([-0.06, 0.06]) and air.sizes["time"] % 2
    waves = 48 // nodes
    inner = slice(60 - waves * nodes // 2, 60 + waves * nodes // 2)
    for time in np.linspace(-0.06, 0.06, 31):
        now = air.interp(time=time).isel(x=0).values[inner, 30:50].mean(1)
        phase = np.angle((now * np.exp(1j * 2 * np.pi / wave * Y[inner])).sum())
        off = phase / (2 * np.pi) * nodes - U[0] * (time + which * DT) / SPACING
        off = (off + nodes / 2) % nodes - nodes / 2
        assert abs(off) < 0.005


def test_states_from_the_largest_displacement(experiment, carried):
    """12.2 m/s in 0.12 s are 2.9 nodes, 12 intervals; an odd number of states."""
    _, flows = carried
    taus = call(state_times, experiment, flows=flows, times=np.array([0.06, -0.06, 0.0]))
    assert len(taus) == 13 and taus[6] == pytest.approx(0, abs=1e-17)
    step = np.hypot(*U) * np.diff(taus) / SPACING
    assert step.max() <= truth_in_time.LARGEST_STEP
    assert len(call(state_times, experiment, flows=flows, times=np.array([0.0, 1e-6]))) == 5
    assert call(state_times, experiment, flows=flows, times=np.array([0.02, 0.02])).tolist() == [
        0.02
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wake_backscatter", "wake_changing"])
def test_the_air_of_the_reference_times_is_the_truth(name):
    """Also of a wake with a second state, where the first scan ends as the second begins."""
    # without texture: waves of two nodes do not survive half a node's displacement
    wake = {"spacing": "1 m", "texture": {"rms": 0}}
    experiment = lm.load_experiment(name, scan={"air": "moving"}, wake=wake)
    flows = flows_of(experiment, experiment.folder)
    truth = make_truth(experiment, flows=flows)
    dt = experiment.platform.dt
    first, second = (
        call(
            air_in_time,
            experiment,
            truth=truth,
            flows=flows,
            which=k,
            times=np.array([-dt / 2, dt / 2]),
        )
        for k in (0, 1)
    )
    middle = first.sizes["time"] // 2
    for air, expected in ((first, truth.extinction[0]), (second, truth.extinction[1])):
        at = air.isel(time=air.sizes["time"] // 2)
        assert np.abs(at.values - expected.values).max() < 1e-6 * float(expected.max())
    # both say the same of the time between; trajectories of the one go forward, the other back
    inner = {"y": slice(4, -4), "z": slice(4, -4)}
    between = [air.isel(inner).values for air in (first.isel(time=-1), second.isel(time=0))]
    scale = float((truth.extinction[1] - truth.extinction[0]).isel(inner).std())
    assert np.std(between[0] - between[1]) < 0.05 * scale
    moved = float((first.isel(time=-1) - first.isel(time=middle)).isel(inner).std())
    assert moved > 0.2 * scale


def test_air_along_x_in_the_frame_of_the_gates():
    """Behind a turbine: 8 m/s, gates that follow with 6 m/s; half a second is two nodes."""
    turbine = lm.load_experiment("turbine", scan={"air": "moving"})
    assert turbine.scan.follow == 6
    x, across = 498 + SPACING * np.arange(49), SPACING * np.arange(6)
    k = 2 * np.pi / WAVE

    def of(values):
        values = np.broadcast_to(np.asarray(values, float)[:, None, None], (49, 6, 6))
        return xr.DataArray(values, {"x": x, "y": across, "z": across}, ("x", "y", "z"))

    waves = of(MEAN * (1 + 0.5 * np.cos(k * (x - x[24]))))
    still, flow = of(np.zeros(49)), of(np.full(49, 8.0))
    truth = Truth((waves, waves), (waves, waves), xr.Dataset())
    flows = (xr.Dataset({"u": flow, "v": still, "w": still}), None)
    air = call(air_in_time, turbine, truth=truth, flows=flows, which=0, times=np.array([-0.5, 0.5]))
    assert air.sizes["time"] == 17  # four nodes in the scan
    inner = slice(8, 40)
    for time in (-0.5, -0.21, 0.0, 0.33, 0.5):
        now = air.interp(time=time).values[inner, 3, 3]
        phase = np.angle((now * np.exp(1j * k * (x[inner] - x[24]))).sum())
        assert phase / k == pytest.approx(2 * time, abs=0.005 * SPACING)


def test_molecules_stay(experiment, carried):
    """They are everywhere the same, and their part is in the sum at any time."""
    truth, flows = carried
    mixed = lm.load_experiment(
        "wake_backscatter",
        platform={"dt": DT},
        scan={"air": "moving"},
        wake={"extinction": {"molecules": "1e-4 / m"}},
    )
    sharp = field(np.where(np.abs(Y) < 5, MEAN, 0)[None, :, None])
    alone = call(
        air_in_time,
        experiment,
        truth=replace(truth, extinction=(sharp, sharp)),
        flows=flows,
        which=0,
        times=np.array([-0.05, 0.05]),
    )
    added = replace(truth, extinction=(sharp + 1e-4, sharp + 1e-4), molecules=1e-4)
    both = call(
        air_in_time, mixed, truth=added, flows=flows, which=0, times=np.array([-0.05, 0.05])
    )
    assert np.abs(both.values - alone.values - 1e-4).max() < 1e-9
    assert both.min() >= 0.999999e-4


def test_uniform_air_has_one_state(experiment, carried):
    truth, flows = carried
    same = replace(truth, extinction=(field(MEAN), field(MEAN)))
    assert (
        "time"
        not in call(
            air_in_time, experiment, truth=same, flows=flows, which=1, times=np.array([-0.05, 0.05])
        ).dims
    )


def test_too_many_states_are_refused(experiment, carried):
    _, flows = carried
    with pytest.raises(lm.InputError, match=r"scan\.air: moving is not allowed here: air moves by"):
        call(state_times, experiment, flows=flows, times=np.array([-1000.0, 1000.0]))


def scan_of(air, times_of_rows, mixed=False, samples=1024):
    """The image of air on the nodes of its middle, row by row at the given times."""
    y, z = Y[36:-36], Z[30:-30]
    (plan,) = plan_scans(Scan(), y, z, (0.0,))
    directions = plan.directions()
    origin = np.zeros_like(directions)
    times = np.repeat(times_of_rows, len(y))
    plan = replace(plan, beams=Beams(times, origin, directions, origin, directions))
    lidar = BackscatterLidar(beam_radius="0.02 m", beam_cut="0.05 m", divergence_full="0.1 mrad")
    solid = extrude(air.isel(x=0).transpose(..., "z", "y"), plan, lidar, [plan])
    (scan,) = render_scans(
        [solid],
        [plan],
        lidar,
        ScatteringAir(
            1e-4, {"type": "rayleigh_polarized"}, 1.0, molecules(1e-4, 532e-9) if mixed else None
        ),
        RenderSettings(max_order=1, samples_per_beam=samples),
        1,
    )
    return scan


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("mixed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_image_shows_every_row_at_its_time(experiment, carried, mixed):
    """The phase of each row of the image: 0.02 nodes, of waves of 8 nodes; 20 rows in 0.1 s.

    In frozen air rows at both ends of the scan are 1 node off.
    """
    truth, flows = carried
    rows = 21
    times = 0.05 * np.linspace(1, -1, rows)  # the top row last
    air = call(air_in_time, experiment, truth=truth, flows=flows, which=0, times=times)
    k = 2 * np.pi / WAVE

    def displaced(air):
        image = scan_of(air, times, mixed)["Y"].sortby("z", ascending=False).values.astype(float)
        y = Y[36:-36][:-1]  # six whole waves
        phase = np.angle((image[:, :-1] * np.exp(1j * k * y)).sum(1))
        return phase / k / SPACING

    off = displaced(air) - U[0] * times / SPACING
    # of a row: shot-like noise of 3 % in 48 pixels, amplitude 0.45: 0.02 nodes; of seven: 0.007
    assert np.abs(off.reshape(3, 7).mean(1)).max() < 0.02
    frozen = displaced(truth.extinction[0])
    assert np.abs(frozen - U[0] * times / SPACING).max() > 0.9
