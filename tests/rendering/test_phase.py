"""From an experiment's words to Mitsuba's phase functions. Detects a lost parameter."""

import mitsuba as mi
import numpy as np
import pytest

from lidar_mi.config import Scattering
from lidar_mi.errors import InputError
from lidar_mi.rendering.phase import phase_function

pytestmark = pytest.mark.usefixtures("variant")


def backscatter(dictionary):
    mei = mi.MediumInteraction3f()
    mei.wi = mi.Vector3f(0, 0, 1)
    mei.sh_frame = mi.Frame3f(0, 0, -1)
    value, _ = mi.load_dict(dictionary).eval_pdf(
        mi.PhaseFunctionContext(), mei, mi.Vector3f(0, 0, 1)
    )
    return np.array(value[0, 0]).ravel()[0]


@pytest.mark.parametrize(
    ("scattering", "expected"),
    [
        (Scattering(), 3 / (8 * np.pi)),
        # Delta = (1 - D) / (1 + D / 2) of the dipole part
        (
            Scattering(depolarization=0.2),
            (0.8 / 1.1 * 1.5 + 0.3 / 1.1) / (4 * np.pi),
        ),
        (Scattering(phase="isotropic"), 1 / (4 * np.pi)),
        (
            Scattering(phase="henyey_greenstein", asymmetry=0.6),
            (1 - 0.36) / (4 * np.pi * 1.6**3),
        ),
    ],
)
def test_phase_function_at_180_degrees(scattering, expected):
    assert backscatter(phase_function(scattering)) == pytest.approx(expected, rel=1e-5)


def test_table_is_found_beside_the_experiment(tmp_path):
    angle = np.linspace(0, 180, 7)
    one = np.ones_like(angle)
    np.savetxt(
        tmp_path / "table.txt", np.column_stack([angle, one, one, one, one, 0 * one, 0 * one])
    )
    found = phase_function(Scattering(phase="table", table="table.txt"), tmp_path)
    assert backscatter(found) == pytest.approx(1 / (4 * np.pi), rel=1e-3)


def test_missing_table_is_named(tmp_path):
    with pytest.raises(InputError, match=r"^scattering\.table: .*absent\.txt not found; expected"):
        phase_function(Scattering(phase="table", table="absent.txt"), tmp_path)
