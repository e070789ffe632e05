"""Molecules beside particles, each with a scattering matrix and an albedo of its own.

Detects a wrong fraction of either (0.3 %) in slab or environment, a part that remains when
the scene moves, and molecules with texture.
"""

import numpy as np
import pytest
import xarray as xr

from lidar_mi.atmosphere.scattering.molecules import molecular_table
from lidar_mi.errors import InputError
from lidar_mi.experiment.truth.extinction import make_truth
from lidar_mi.instrument.lidar import BackscatterLidar
from lidar_mi.instrument.scan import Scan, plan_scans
from lidar_mi.io.scattering_table import aerosol_table
from lidar_mi.rendering.backscatter import extrude, render_scans
from lidar_mi.rendering.phase import ScatteringAir, molecules, scatterer
from lidar_mi.rendering.settings import RenderSettings
from lidar_mi.schema.reading import check
from lidar_mi.schema.scattering import Scattering

WAVELENGTH, MOLECULES, AROUND = 532e-9, 7e-5, 1e-4
AXIS = np.arange(-4.0, 4.5, 0.5)


def scans(fields, settings):
    plans = plan_scans(Scan(range=100, thickness=2.5), AXIS, AXIS, (0.0, 5.0))
    lidar = BackscatterLidar(fov_half="20 mrad", divergence_full="0.1 mrad")
    solid = [extrude(field, plans[0], lidar) for field in fields]
    scattering = Scattering(phase="aerosol", aerosol="spheroids")
    air = ScatteringAir(
        AROUND + MOLECULES,
        *scatterer(scattering, wavelength=WAVELENGTH),
        molecules(MOLECULES, WAVELENGTH),
    )
    return list(render_scans(solid, plans, lidar, air, settings, 1))


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_backscatter_is_the_sum_of_both():
    """Single scattering of uniform slabs, one after the other: particles' and molecules' beta.

    Y is beta (1 - exp(-2 E dr)) / (2 E dr) with the lidar ratios of the tables, not of the plugins.
    """
    extinctions = (5e-4, 2e-3)
    fields = [
        xr.DataArray(
            np.full((len(AXIS),) * 2, value + MOLECULES), {"z": AXIS, "y": AXIS}, ("z", "y")
        )
        for value in extinctions
    ]
    per = [aerosol_table("spheroids", WAVELENGTH), molecular_table(WAVELENGTH, band="cabannes")]
    found = scans(fields, RenderSettings(samples_per_beam=256, max_order=1))
    for scan, value in zip(found, extinctions, strict=True):
        beta = (
            value * per[0].backscatter_per_extinction
            + MOLECULES * per[1].backscatter_per_extinction
        )
        depth = 2 * (value + MOLECULES) * 2.5
        middle = scan["Y"].sel(y=slice(-2, 2), z=slice(-2, 2))
        expected = beta * -np.expm1(-depth) / depth
        assert float(middle.mean()) == pytest.approx(expected, rel=3e-3)


@pytest.mark.usefixtures("variant")
def test_light_is_depolarised_by_particles_alone():
    """S1 / S0 is the mean of both, weighted with what each sends back."""
    field = xr.DataArray(
        np.full((len(AXIS),) * 2, 5e-4 + MOLECULES), {"z": AXIS, "y": AXIS}, ("z", "y")
    )
    scan = scans([field, field], RenderSettings(samples_per_beam=256, max_order=1))[0].isel(gate=0)
    tables = aerosol_table("spheroids", WAVELENGTH), molecular_table(WAVELENGTH, band="cabannes")
    betas = [
        e * t.backscatter_per_extinction for e, t in zip((5e-4, MOLECULES), tables, strict=True)
    ]
    kept = [(1 - t.depolarization_ratio) / (1 + t.depolarization_ratio) for t in tables]
    expected = np.dot(betas, kept) / sum(betas)
    assert float(scan["S1"].sum() / scan["S0"].sum()) == pytest.approx(expected, rel=3e-3)


def experiment(**extinction):
    return check(
        {
            "name": "air",
            "wake": {
                "vortex_pair": {"width": 20, "height": 20},
                "spacing": 0.5,
                "extinction": extinction,
            },
        },
        "air",
    )


def test_molecules_have_no_texture():
    """They raise the extinction everywhere alike, at both times."""
    with_them, without = (make_truth(experiment(molecules=m)) for m in (7e-5, 0))
    for one, other in zip(with_them.extinction, without.extinction, strict=True):
        np.testing.assert_allclose(one - other, 7e-5, rtol=1e-9)
    assert float(without.extinction[0].std()) > 5e-6


def test_unpolarised_particles_have_no_molecules_beside():
    data = {
        "name": "air",
        "wake": {"vortex_pair": {}, "extinction": {"molecules": 7e-5}},
        "scattering": {"phase": "isotropic"},
    }
    with pytest.raises(InputError) as error:
        check(data, "air")
    assert "wake.extinction.molecules: not allowed with scattering.phase isotropic" in str(
        error.value
    )
