"""Laws between the numbers of molecular scattering. Detects any mix-up of Cabannes line and whole
Rayleigh band. `validation.molecules` has the published numbers; tests/validation runs it."""

import pytest

from lidar_mi.atmosphere.scattering import molecules
from lidar_mi.errors import InputError


def test_refractive_index_rises_with_carbon_dioxide():
    # CO2 raises the refractivity by 54 % of its share
    ratio = (molecules.refractive_index(532e-9, 0.01) - 1) / (
        molecules.refractive_index(532e-9, 0.0) - 1
    )
    assert ratio == pytest.approx((1 + 0.54 * 0.0097) / (1 - 0.54 * 0.0003), rel=1e-12)


def test_sum_over_lines_is_the_whole_band():
    """Cabannes + Raman = whole: the Raman part is pure anisotropic scattering, three quarters."""
    king = molecules.king_factor(532e-9)
    whole = molecules.anisotropy(king, "rayleigh")
    narrow = molecules.molecular_scattering(532e-9, band="cabannes")
    raman = 7.5 * whole / (45 + 10 * whole)
    assert narrow.albedo + raman == pytest.approx(1, rel=1e-12)


def test_table_agrees_with_the_coefficients():
    for band in molecules.BANDS:
        air = molecules.molecular_scattering(355e-9, 26500.0, 223.25, band)
        table = molecules.molecular_table(355e-9, 26500.0, 223.25, band)
        assert table.extinction == pytest.approx(air.extinction, rel=1e-12)
        assert table.backscatter == pytest.approx(air.backscatter, rel=1e-12)
        assert table.lidar_ratio == pytest.approx(air.lidar_ratio, rel=1e-12)
        assert table.depolarization_ratio == pytest.approx(air.depolarization_ratio, rel=1e-12)
        assert table.albedo == air.albedo


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: molecules.cross_section(532.0), "wavelength: 532.0 m"),
        (lambda: molecules.cross_section(532e-9, co2=360), "co2: 360"),
        (lambda: molecules.number_density(-1.0, 300.0), "pressure: -1.0"),
        (lambda: molecules.number_density(1e5, float("nan")), "temperature: nan"),
        (lambda: molecules.molecular_scattering(532e-9, band="raman"), "band: 'raman'.*cabannes"),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(InputError, match=words):
        call()
