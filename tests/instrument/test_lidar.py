"""The description of the backscatter lidar. Detects a wrong default, unit or limit."""

import math

import pytest
from pydantic import ValidationError

from lidar_mi.instrument.lidar import BackscatterLidar


def test_area_is_that_of_the_disc():
    assert BackscatterLidar(aperture_radius=0.2).aperture_area == pytest.approx(0.125663706)


def test_collimated_and_uncut_beams_are_allowed():
    lidar = BackscatterLidar(divergence_full=0, beam_cut=math.inf)
    assert lidar.divergence_full == 0 and lidar.beam_cut == math.inf


@pytest.mark.parametrize(
    "bad",
    [
        {"wavelength": 0},
        {"wavelength": "532 THz"},
        {"wavelength": math.inf},
        {"beam_radius": "-0.1 m"},
        {"beam_radius": math.inf},
        {"beam_cut": 0},
        {"beam_cut": math.nan},
        {"divergence_full": "-2 mrad"},
        {"divergence_full": 2.0},
        {"divergence_full": "0.6 rad"},
        {"pulse_energy": "0 J"},
        {"pulse_duration": "-1 ns"},
        {"aperture_radius": -0.5},
        {"aperture_radius": math.inf},
        {"fov_half": 0},
        {"fov_half": "1 rad"},
        {"stokes": (2, 0, 0, 0)},
        {"stokes": (1, 1, 1, 0)},
        {"stokes": (1, math.nan, 0, 0)},
        {"stokes": (1, 0, 0)},
        {"colour": "green"},
    ],
)
def test_bad_values_are_refused(bad):
    with pytest.raises(ValidationError) as error:
        BackscatterLidar(**bad)
    assert error.value.errors()[0]["loc"][0] == next(iter(bad))
