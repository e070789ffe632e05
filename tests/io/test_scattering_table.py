"""Scattering tables as files and those that ship: physics tests. Detect a number changed by writing
and reading, a broken file accepted, and a shipped table that is not what its name says. Tests that
compute need the library scatrs."""

import math
import re
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from lidar_mi.atmosphere.scattering import particle_scattering
from lidar_mi.atmosphere.scattering.aerosols import AEROSOLS
from lidar_mi.atmosphere.scattering.molecules import molecular_table
from lidar_mi.atmosphere.scattering.particle_scattering import make_table
from lidar_mi.atmosphere.scattering.tables import mix, rayleigh_table
from lidar_mi.errors import InputError
from lidar_mi.io import scattering_table
from lidar_mi.io.scattering_table import aerosol_table, read_table, write_table

GREEN = 532e-9


@pytest.fixture
def scatrs():
    return pytest.importorskip("scatrs", reason="scatrs (extra 'particles') is not installed")


def shipped(name, nanometres=532):
    return files("lidar_mi.scenes") / f"aerosol_{name}_{nanometres}nm.txt"


def test_file_round_trip_and_plain_numpy(tmp_path):
    table = mix(
        [read_table(shipped("dust")), rayleigh_table(0.0284, 532e-9, 5.167e-31)],
        [5e-5, 1.3e-5],
        "both",
    )
    path = tmp_path / "both.txt"
    write_table(table, path)
    again = read_table(path)
    np.testing.assert_array_equal(again.angle, table.angle)
    np.testing.assert_allclose(again.elements, table.elements, rtol=6e-7, atol=1e-12)
    for name in ("wavelength", "extinction_cross_section", "albedo", "number_density"):
        assert getattr(again, name) == pytest.approx(getattr(table, name), rel=1e-6)
    assert again.name == "both" and again.provenance == table.provenance
    assert again.lidar_ratio == pytest.approx(table.lidar_ratio, rel=1e-6)
    numbers = np.loadtxt(path)
    assert numbers.shape == (len(table.angle), 7)
    np.testing.assert_allclose(numbers[:, 1], table.elements[:, 0], rtol=6e-7)


def test_unreadable_files(tmp_path):
    path = tmp_path / "t.txt"
    with pytest.raises(InputError, match="No such file"):
        read_table(path)
    write_table(rayleigh_table(0.03, 532e-9, 5e-31, albedo=0.9), path)
    text = path.read_text()
    cases = {
        "\n".join(line for line in text.splitlines() if "albedo" not in line): "single_scattering",
        text.replace("wavelength_m: 5.32e-07", "wavelength_m: green"): "wavelength_m: 'green'",
        text.replace("albedo: 0.9", "albedo: 1.9"): "albedo: 1.9",
        "# nothing\n1 2 3\n4 5 6\n": "3 columns",
        text + "words\n": "not a table",
        "# name: soot\n": "no row",
    }
    for content, words in cases.items():
        path.write_text(content)
        with pytest.raises(InputError, match=f"t.txt.*{words}"):
            read_table(path)


@pytest.mark.parametrize("name", sorted(AEROSOLS))
def test_shipped_table_agrees_with_its_header(name):
    """`read_table` checks normalisation, inequalities and the relations at 0 and 180 degrees."""
    table = read_table(shipped(name))
    preset = AEROSOLS[name]
    assert table.name == name and table.wavelength == pytest.approx(GREEN)
    assert table.number_density == pytest.approx(preset.number_density)
    m = preset.refractive_index(GREEN)
    assert f"m = {m.real:.4g} + {m.imag:.3g}i" in table.provenance
    assert particle_scattering._sizes_text(preset.sizes) in table.provenance
    assert len(table.angle) == 361
    assert shipped(name).stat().st_size < 60_000
    a1, a2, a3, a4 = table.elements.T[:4]
    if preset.elongation == 1:
        np.testing.assert_array_equal(a2, a1)
        np.testing.assert_array_equal(a3, a4)
        assert table.depolarization_ratio == 0
    else:
        assert table.depolarization_ratio > 0.05


@pytest.mark.parametrize("name", sorted(AEROSOLS))
def test_shipped_table_is_read_by_the_phase_function(name):
    """The plug-in takes the file as it is; its own normalisation changes a1 by less than 0.1 %."""
    check_table = pytest.importorskip("lidar_mi.plugins.mueller").check_table
    numbers = np.loadtxt(shipped(name))
    scaled = check_table(numbers)
    np.testing.assert_allclose(scaled[:, 1:] * 4 * math.pi, numbers[:, 1:], rtol=1e-3, atol=1e-12)


def test_shipped_spheroids():
    """532 nm, 1.53 + 0.008i, log-normal 0.20 um, 1.7, two to one: lidar ratio about 76 sr and
    depolarisation about 0.27, as found before with another program; spheres of the same volumes
    scatter back three times as much."""
    spheroids, spheres = read_table(shipped("spheroids")), read_table(shipped("spheres"))
    assert spheroids.lidar_ratio == pytest.approx(76, rel=0.03)
    assert spheroids.depolarization_ratio == pytest.approx(0.27, abs=0.01)
    assert 2.5 < spheroids.lidar_ratio / spheres.lidar_ratio < 3.5
    # elongation hardly changes what is taken out of the beam
    assert spheroids.extinction_cross_section == pytest.approx(
        spheres.extinction_cross_section, rel=0.05
    )


@pytest.mark.parametrize("name", ["spheres", "continental", "soot"])
def test_shipped_spheres_can_be_made_again(scatrs, name):
    table = read_table(shipped(name))
    again = make_table(name, GREEN, nodes=1000)
    assert again.lidar_ratio == pytest.approx(table.lidar_ratio, rel=2e-3)
    assert again.extinction_cross_section == pytest.approx(table.extinction_cross_section, rel=1e-3)
    np.testing.assert_allclose(
        again.elements / table.elements[:, :1], table.elements / table.elements[:, :1], atol=5e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spheroids", "dust"])
def test_shipped_spheroids_can_be_made_again(scatrs, name):
    """The whole table again with fewer sizes: the size average has converged to 2 % backwards."""
    table = read_table(shipped(name))
    again = make_table(name, GREEN, nodes=48)
    assert again.lidar_ratio == pytest.approx(table.lidar_ratio, rel=0.02)
    assert again.depolarization_ratio == pytest.approx(table.depolarization_ratio, rel=0.02)
    assert again.extinction_cross_section == pytest.approx(table.extinction_cross_section, rel=5e-3)


def test_named_aerosol_is_from_the_shipped_table_only_at_its_wavelength(monkeypatch):
    made = []
    monkeypatch.setattr(scattering_table, "make_table", lambda *given, **_: made.append(given))
    assert aerosol_table("dust", GREEN).name == "dust" and not made
    aerosol_table("dust", 532.4e-9)
    aerosol_table("dust", 1064e-9)
    assert made == [("dust", 532.4e-9), ("dust", 1064e-9)]
    with pytest.raises(InputError, match="'smoke'"):
        aerosol_table("smoke", GREEN)


def test_aerosol_in_air():
    """A tenth per kilometre of spheroids in sea-level air: coefficients add, and depolarised and
    polarised backscatter each add too (Tesche et al. 2009, eq. 4)."""
    aerosol = aerosol_table("spheroids", GREEN)
    aerosol = replace(aerosol, number_density=1e-4 / aerosol.extinction_cross_section)
    air = molecular_table(GREEN)
    both = mix([aerosol, air], [aerosol.extinction, air.extinction])
    assert both.extinction == pytest.approx(1e-4 + 1.316e-5, rel=1e-4)
    assert both.backscatter == pytest.approx(aerosol.backscatter + air.backscatter, rel=1e-9)

    def crossed(table):
        ratio = table.depolarization_ratio
        return table.backscatter * ratio / (1 + ratio)

    assert crossed(both) == pytest.approx(crossed(aerosol) + crossed(air), rel=1e-9)


@pytest.mark.parametrize(
    ("nm", "aerosol"), [(355, "spheres"), (532, "spheroids"), (1550, "spheroids")]
)
def test_shipped_spheroids_have_the_index_of_dust(nm, aerosol):
    """What a table says it was made of is what the aerosol has at that wavelength."""
    output = re.search(
        r"m = ([\d.]+) \+ ([\d.]+)i", read_table(shipped("spheroids", nm)).provenance
    )
    m = AEROSOLS[aerosol].refractive_index(nm * 1e-9)
    assert complex(float(output[1]), float(output[2])) == pytest.approx(m, rel=1e-9)
