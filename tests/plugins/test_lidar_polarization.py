"""The Stokes vector a lidar receives, about the horizontal axis e_h of both directions.

Detects: a sign of S1, S2 or S3, a reference axis turned by 1e-5 rad.
"""

import math

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("variant")

EMITTED = {
    "horizontal": (1, 1, 0, 0),
    "vertical": (1, -1, 0, 0),
    "plus 45 degrees": (1, 0, 1, 0),
    "minus 45 degrees": (1, 0, -1, 0),
    "circular": (1, 0, 0, 1),
    "elliptic, partly polarised": (1, 0.3, -0.4, 0.6),
    "natural": (1, 0, 0, 0),
}


def scan(world, emitted, phase, environment=None, **parameters):
    """5 x 3 beams over +-40 by +-30 degrees, collimated, a slab around 500 m."""
    stokes = ", ".join(map(str, emitted))
    scene = world.scene(
        world.lidar(
            (5, 3),
            (500.0, 502.5),
            {"stokes": stokes, "divergence_full_mrad": 0.0},
            environment=world.ENVIRONMENT,
            **(
                {
                    "azimuth_min_deg": -40.0,
                    "azimuth_max_deg": 40.0,
                    "elevation_min_deg": -30.0,
                    "elevation_max_deg": 30.0,
                }
                | parameters
            ),
        ),
        environment=world.homogeneous(1e-4, environment or phase),
        slab=world.box(
            [480, -600, -600], [520, 600, 600], world.homogeneous(1e-3, phase), world.ENVIRONMENT
        ),
    )
    return world.render(scene, seed=1, spp=256)[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", EMITTED)
@pytest.mark.parametrize("phase", ["rayleigh_polarized", "mueller"])
def test_backscatter_turns_the_signs_of_u_and_v(world, name, phase):
    """diag(1, 1, -1, -1): the field stays, the direction of view is reversed."""
    if phase == "mueller":
        angle = np.linspace(0, 180, 19)
        cosine = np.cos(np.radians(angle))
        a1, b1 = 0.75 * (1 + cosine**2), -0.75 * (1 - cosine**2)
        table = np.column_stack([angle, a1, a1, 1.5 * cosine, 1.5 * cosine, b1, 0 * angle])
        phase = {"type": "mueller", "table": mi.TensorXf(table)}
    stokes = scan(world, EMITTED[name], phase)[0]
    i, q, u, v = EMITTED[name]
    expected = np.array([i, q, -u, -v])[:, None, None]
    # light comes back up to 1 mrad off: second order in that
    assert np.abs(stokes / stokes[0] - expected).max() < 1e-5


@pytest.mark.parametrize(
    ("phase", "value"),
    [
        ({"type": "isotropic"}, 1 / (4 * math.pi)),
        ({"type": "hg", "g": 0.6}, (1 - 0.36) / (4 * math.pi * 1.6**3)),
    ],
)
@pytest.mark.parametrize("name", ["horizontal", "circular"])
def test_phase_functions_without_polarisation_depolarise_completely(world, phase, value, name):
    stokes = scan(world, EMITTED[name], phase)[0]
    assert (stokes[1:] == 0).all()
    rayleigh = scan(world, EMITTED[name], "rayleigh_polarized")[0]
    # the same random numbers, another value at 180 degrees
    assert stokes[0] / rayleigh[0] == pytest.approx(value * 8 * math.pi / 3, rel=1e-5)


def test_each_medium_scatters_by_its_own_phase_function(world):
    """Two gates, one in the isotropic environment, one in the Rayleigh slab."""
    stokes = scan(
        world,
        (1, 1, 0, 0),
        "rayleigh_polarized",
        "isotropic",
        gate_start=400.0,
        gate_stop=500.0,
        gate_count=5,
    )
    assert (stokes[:4, 1:] == 0).all() and (stokes[:4, 0] > 0).all()
    assert stokes[4, 1] == pytest.approx(stokes[4, 0], rel=1e-4)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb"], indirect=True)
def test_unpolarised_variants_carry_intensity_only(world, variant):
    stokes = scan(world, (1, 1, 0, 0), "rayleigh_polarized")[0]
    assert (stokes[0] > 0).all() and (stokes[1:] == 0).all()


@pytest.mark.parametrize(
    ("direction", "roll"),
    [((0, 0, 1), 0), ((0, 0, -1), 0), ((1e-3, 2e-3, 1), 0), ((1, 0, 0), 30), ((1, 0.3, 0.2), 77)],
)
def test_axes_belong_to_the_instrument(world, direction, roll):
    """Straight up, where photons have every horizontal axis, and in a rolled aircraft.

    The analyser is fixed to the telescope, as the laser is: the Stokes vector does not turn.
    """
    emitted = (1, 0.6, 0.64, 0.48)
    scene = world.scene(
        world.lidar(
            (1, 1),
            (500.0, 510.0),
            {"stokes": ", ".join(map(str, emitted))},
            environment=world.homogeneous(1e-3),
            directions=mi.TensorXf([direction]),
            gate_kind="spherical",
            to_world=mi.ScalarTransform4f().rotate([1, 0, 0], roll),
        )
    )
    i, q, u, v = world.render(scene, seed=2, spp=10_000)[0][0, :, 0, 0]
    assert np.array([q, -u, -v]) / i == pytest.approx(np.array(emitted[1:]), abs=2e-5)
