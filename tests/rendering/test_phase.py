"""From an experiment's words to Mitsuba's phase functions.

Detects a lost parameter, an albedo that is not the scatterers', a mixture that is weighted by
anything but scattering coefficients (1e-4 in backscatter and depolarisation)."""

import mitsuba as mi
import numpy as np
import pytest

from lidar_mi.atmosphere.scattering.molecules import molecular_scattering
from lidar_mi.errors import InputError
from lidar_mi.io.scattering_table import aerosol_table, is_complete, write_table
from lidar_mi.rendering.phase import backscatter_phase_function, loadable, scatterer, table_files
from lidar_mi.schema.scattering import Scattering

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize(
    ("scattering", "expected"),
    [
        (Scattering(phase="rayleigh"), 3 / (8 * np.pi)),
        # Delta = (1 - D) / (1 + D / 2) of the dipole part
        (
            Scattering(phase="rayleigh", depolarization=0.2),
            (0.8 / 1.1 * 1.5 + 0.3 / 1.1) / (4 * np.pi),
        ),
        (Scattering(phase="isotropic"), 1 / (4 * np.pi)),
        (Scattering(phase="henyey_greenstein", asymmetry=0.6), (1 - 0.36) / (4 * np.pi * 1.6**3)),
    ],
)
def test_phase_function_at_180_degrees(scattering, expected):
    assert backscatter_phase_function(scatterer(scattering)) == pytest.approx(expected, rel=1e-5)


def test_table_is_found_beside_the_experiment(tmp_path):
    angle = np.linspace(0, 180, 7)
    one = np.ones_like(angle)
    np.savetxt(
        tmp_path / "table.txt", np.column_stack([angle, one, one, one, one, 0 * one, 0 * one])
    )
    found = scatterer(Scattering(phase="table", table="table.txt"), tmp_path)
    assert found.albedo == 1  # the file says nothing of it
    assert backscatter_phase_function(found) == pytest.approx(1 / (4 * np.pi), rel=1e-3)


def test_table_is_found_among_those_shipped(tmp_path):
    """One of the same name in the folder comes first."""
    name = "aerosol_dust_532nm.txt"
    asked = Scattering(phase="table", table=name)
    path = table_files(asked, tmp_path)["scattering.table"]
    assert path.name == name and path.parent != tmp_path.resolve() and is_complete(path)
    (tmp_path / name).write_text("mine")
    assert table_files(asked, tmp_path)["scattering.table"] == (tmp_path / name).resolve()


def test_missing_table_is_named(tmp_path):
    with pytest.raises(InputError, match=r"^scattering\.table: .*absent\.txt not found; expected"):
        scatterer(Scattering(phase="table", table="absent.txt"), tmp_path)


def test_a_table_brings_its_albedo(tmp_path):
    write_table(aerosol_table("soot", 532e-9), tmp_path / "soot.txt")
    soot = Scattering(phase="table", table="soot.txt")
    assert scatterer(soot, tmp_path).albedo == pytest.approx(0.21553, abs=1e-5)
    assert scatterer(soot.model_copy(update={"albedo": 0.5}), tmp_path).albedo == 0.5
    with pytest.raises(InputError, match=r"soot.txt is not allowed; it is for 532 nm, expected"):
        scatterer(soot, tmp_path, 355e-9)


def matrix(dictionary, cosine):
    """Phase matrix at a scattering angle in the horizontal plane, times 4 pi, (4, 4)."""
    mei = mi.MediumInteraction3f()
    mei.wi = mi.Vector3f(0, 0, 1)
    mei.sh_frame = mi.Frame3f(0, 0, -1)
    wo = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, -cosine)
    value, _ = mi.load_dict(loadable(dictionary)).eval_pdf(mi.PhaseFunctionContext(), mei, wo)
    return (
        4
        * np.pi
        * np.array([[np.array(value[i, j]).ravel()[0] for j in range(4)] for i in range(4)])
    )


def test_molecules_are_those_of_the_wavelength():
    """Backscatter and depolarisation of the Cabannes line at 355 nm; the albedo it leaves."""
    air = molecular_scattering(355e-9, band="cabannes")
    found = scatterer(Scattering(phase="molecules"), wavelength=355e-9)
    assert found.albedo == air.albedo
    back = matrix(found.phase, -1)
    per_extinction = found.albedo * back[0, 0] / (4 * np.pi)
    assert per_extinction == pytest.approx(1 / air.lidar_ratio, rel=1e-5)
    ratio = (back[0, 0] - back[1, 1]) / (back[0, 0] + back[1, 1])
    assert ratio == pytest.approx(air.depolarization_ratio, rel=2e-3)  # in float32
    whole = scatterer(Scattering(phase="molecules", band="rayleigh"), wavelength=355e-9)
    assert whole.albedo == pytest.approx(1)


@pytest.mark.parametrize("cosine", [-1.0, -0.3, 0.8])
def test_a_mixture_is_weighted_by_scattering_coefficient(cosine):
    """Three parts of soot (albedo 0.22) and one of molecules: by hand from the parts alone."""
    parts = [
        {"phase": "aerosol", "aerosol": "soot", "fraction": 3},
        {"phase": "rayleigh", "depolarization": 0.1, "fraction": 1},
    ]
    mixture = scatterer(Scattering.model_validate({"phase": "mixture", "parts": parts}))
    soot = scatterer(Scattering(phase="aerosol", aerosol="soot"))
    molecules = scatterer(Scattering(phase="rayleigh", depolarization=0.1))
    assert mixture.albedo == pytest.approx((3 * soot.albedo + 1) / 4)
    weight = 3 * soot.albedo / (3 * soot.albedo + 1)
    expected = weight * matrix(soot.phase, cosine) + (1 - weight) * matrix(molecules.phase, cosine)
    # molecules are a table of one degree here: 8e-5 of a1
    np.testing.assert_allclose(matrix(mixture.phase, cosine), expected, atol=2e-4 * expected[0, 0])


def test_tables_of_a_mixture_are_found(tmp_path):
    write_table(aerosol_table("dust", 532e-9), tmp_path / "dust.txt")
    parts = [
        {"phase": "molecules", "fraction": 1},
        {"phase": "table", "table": "dust.txt", "fraction": 1},
    ]
    mixture = Scattering.model_validate({"phase": "mixture", "parts": parts})
    found = {"scattering.parts.1.table": (tmp_path / "dust.txt").resolve()}
    assert table_files(mixture, tmp_path) == found
    assert scatterer(mixture, tmp_path).phase["type"] == "mueller"
    with pytest.raises(InputError, match=r"^scattering\.parts\.1\.table: .*dust.txt not found"):
        table_files(mixture, tmp_path / "elsewhere")
