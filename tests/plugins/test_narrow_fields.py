"""Light of order two in narrow fields of view against a quadrature in double precision.

Detects: 1 % of it lost or added, at any field of view, telescope and range.
"""

import warnings

import mitsuba as mi
import numpy as np
import pytest

from validation.second_order import Bistatic, second_order

pytestmark = pytest.mark.usefixtures("variant")

FAR = {"slab": (2000.0, 2200.0), "gate": (2050.0, 2060.0)}
CASES = [
    Bistatic(fov_half=0.05e-3, aperture=0.02),
    Bistatic(fov_half=0.25e-3, aperture=0.2),
    Bistatic(fov_half=0.5e-3, aperture=0.2, asymmetry=None),
    Bistatic(fov_half=5e-3, aperture=0.5, asymmetry=0.85),
    Bistatic(fov_half=0.05e-3, aperture=0.1, **FAR),
]


def pencil(world, case, place=None, **integrator):
    """One thin, collimated beam, and one gate of order two in a slab."""
    phase = {"type": "hg", "g": case.asymmetry}
    phase = "rayleigh_polarized" if case.asymmetry is None else phase
    air = world.homogeneous(case.extinction, phase, case.albedo)
    (near, far), wide = case.slab, 1000.0
    slab = world.box((near, -wide, -wide), (far, wide, wide), air)
    place = mi.ScalarTransform4f() if place is None else place
    return world.scene(
        world.lidar(
            (1, 1),
            case.gate,
            laser={"beam_radius": 1e-6, "divergence_full_mrad": 0.0},
            gate_kind="spherical",
            aperture_radius=case.aperture,
            fov_half_mrad=1e3 * case.fov_half,
            to_world=place,
        ),
        {"max_order": 2, "orders": True, **integrator},
        slab=slab | {"to_world": place @ slab["to_world"]},
    )


@pytest.mark.parametrize("case", CASES)
def test_no_light_is_lost_in_a_narrow_field(world, case):
    loaded = pencil(world, case)
    found = np.stack([np.array(mi.render(loaded, spp=20_000, seed=k))[0, 0] for k in range(20)])
    # S1 of single scattering is that of the laser, or 0
    first = found[:, 5] if case.asymmetry is None else 0
    found = np.stack([found[:, 6], found[:, 1] - first], -1).astype(float)
    expected = second_order(case, 16)[:2]
    error = found.std(0, ddof=1) / np.sqrt(len(found))
    assert error[0] < 0.01 * expected[0]
    np.testing.assert_array_less(abs(found.mean(0) - expected), 4 * error + 1e-3 * expected[0])
    assert loaded.integrator().rejected < 1e-4 * 20_000


def test_samples_lost_to_rounding_are_counted_and_said_once(world):
    """Coordinates of 20 km are rounded to millimetres, as wide as a field of 0.05 mrad is here."""
    case, place = CASES[0], mi.ScalarTransform4f().translate([0.0, 20_000.0, 20_000.0])
    loaded = pencil(world, case, place)
    with pytest.warns(UserWarning, match="samples left the field of view by rounding"):
        found = np.array(mi.render(loaded, spp=400_000, seed=1))[0, 0]
    rejected = loaded.integrator().rejected / 400_000
    lost = 1 - found[6] / second_order(case, 16)[0]
    assert 0.5 * lost < rejected < 2 * lost and lost > 0.03
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.render(loaded, spp=1000, seed=2)
