"""The example programs, made small. Detects one that does not run or misses its result."""

import runpy
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from lidar_mi.atmosphere.air.turbulence import turbulence

EXAMPLES = Path(__file__).parents[2] / "examples"

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.slow
def test_a_blurred_slab_is_recovered_by_gradient_descent():
    """With 1/10 of the full example's beams and 1/5 of its steps the error decreases by 25 %.

    From 11 % of blur against the true air; 20 % are required, as the seeds change it by 1 % of the
    whole. The remaining misfit is mostly the noise of 32 samples per beam.
    """
    example = runpy.run_path(str(EXAMPLES / "recover_slab.py"))
    truth = example["port_vortex"](10, 8)
    guess, found, misfits = example["recover"](truth, steps=12, samples=32, learning_rate=0.05)
    error = example["error"]
    assert error(guess, truth) > 0.08
    assert error(found, truth) < 0.8 * error(guess, truth)
    assert misfits[-1] < 0.7 * misfits[0]
    assert found.shape == truth.shape and float(found.min()) > 0


def test_own_simulation_steps_the_lidar(capsys):
    """Two slabs with 1/4 of the samples: circulations within 5 stated errors of the truth."""
    example = runpy.run_path(str(EXAMPLES / "own_simulation.py"))
    found = example["main"](slabs=2, samples=16)
    assert found and capsys.readouterr().out.count("m^2/s") == 2 * len(found)
    assert all(abs(value - true) < 5 * error for value, error, true in found)


@pytest.mark.slow
def test_fog_is_recovered_by_inverting_the_renderer(capsys):
    """Optical depth 1, an eighth of the samples: 2 % by all orders, 11 % by Klett."""
    example = runpy.run_path(str(EXAMPLES / "dense.py"))
    ((depth, multiple, by_klett, single, found),) = example["main"](None, 4096, (1.0,))
    assert 0.1 < multiple < 0.2
    assert by_klett > 0.08 and single > by_klett
    assert found < 0.05
    assert f"optical depth {depth:g}" in capsys.readouterr().out


@pytest.mark.slow
def test_the_example_runs_from_the_command_line(tmp_path, monkeypatch, capsys):
    image = tmp_path / "slab.png"
    options = ["--steps", "1", "--samples", "4", "--out", str(image)]
    monkeypatch.setattr(sys, "argv", ["recover_slab.py", *options])
    runpy.run_path(str(EXAMPLES / "recover_slab.py"), run_name="__main__")
    assert "error" in capsys.readouterr().out
    assert matplotlib.image.imread(image).std() > 0.1


def test_coherence_of_evolving_air_is_that_of_its_waves():
    """Two places along the wind in 40 realisations, no lidar; by jackknife within 4 sigma."""
    expected = runpy.run_path(str(EXAMPLES / "inflow.py"))["expected"]
    air = {"speed": 10.0, "sigma": 1.2, "length": 120.0, "shortest": 5.0}
    air |= {"gate": 0.0, "pulse": 0.0}
    apart, delay, size = 90.0, 9, 256
    time, taper = np.arange(size + delay, dtype=float), np.hanning(size)
    spectra = []
    for seed in range(40):
        field = turbulence(1.2, 120.0, seed, shortest=5.0, evolution="sweeping")
        u = [field.velocity(x - 10 * time, 0.0, 100.0, time)[0] for x in (0.0, -apart)]
        near, far = np.fft.rfft(taper * u[0][delay:]), np.fft.rfft(taper * u[1][:size])
        spectra.append((near * far.conj(), abs(near) ** 2, abs(far) ** 2))
    spectra, frequency = np.array(spectra), np.fft.rfftfreq(size)
    for low, high in ((0.01, 0.03), (0.03, 0.06), (0.06, 0.1)):
        band = (frequency >= low) & (frequency < high)
        sums = spectra[..., band].sum(-1)

        def coherence(rows):
            cross, one, other = rows.sum(0)
            return abs(cross) ** 2 / (one * other).real

        parts = [coherence(np.delete(sums, k, 0)) for k in range(len(sums))]
        sigma = np.std(parts) * np.sqrt(len(parts) - 1)
        theory = np.mean([expected(one, apart, air) for one in frequency[band]])
        assert coherence(sums) == pytest.approx(theory, abs=4 * sigma), low
        assert sigma < 0.08


@pytest.mark.slow
def test_two_gates_of_a_nacelle_lidar_have_the_coherence_of_the_air(capsys):
    """12 realisations scatter by 0.03 to 0.1 in a band; their mean over 15 bands by 0.02."""
    rows = runpy.run_path(str(EXAMPLES / "inflow.py"))["main"](12, None)
    assert len(rows) == 15
    for apart, at, measured, theory in rows:
        assert measured == pytest.approx(theory, abs=0.25), (apart, at)
    assert np.mean([row[2] - row[3] for row in rows]) == pytest.approx(0, abs=0.06)
