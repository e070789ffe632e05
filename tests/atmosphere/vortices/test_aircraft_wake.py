"""Wakes of aircraft types. Unit and physics tier.

Detects: a wake without the lift of its aircraft, a type with numbers that are not those of an
airliner, keys given beside the aircraft that are lost, an unknown type that is accepted.
"""

import pytest
from pydantic import ValidationError

from lidar_mi.atmosphere.vortices.aircraft_wake import TYPES, wake_of
from lidar_mi.schema.wake import VortexPair


def test_the_pair_carries_the_aircraft():
    """Impulse per time rho Gamma b_0 V is the weight (Saffman 1992)."""
    found = wake_of(60.0, 180e3, 80.0, 1.2)
    assert 1.2 * found.circulation * found.separation * 80.0 == pytest.approx(180e3 * 9.80665)
    assert found.separation == pytest.approx(47.12, abs=0.01)  # that of the paper
    assert found.core_radius == pytest.approx(3.0)


def test_types():
    """Wing spans by ICAO code letters C to F, and wing loads per span of airliners."""
    for designator, kind in TYPES.items():
        assert len(designator) == 4 and 23 < kind.span < 80
        assert 1200 < kind.landing_mass / kind.span < 5000
    pair = VortexPair(aircraft="A343")
    # 458 m^2/s is the paper's wake of a large four-engined aircraft
    assert pair.circulation == pytest.approx(458, rel=0.05)
    assert pair.separation == pytest.approx(47.1, rel=0.01)


def test_what_is_given_overrides_the_aircraft():
    pair = VortexPair(aircraft="A320", mass="60 t", speed="70 m/s", altitude="0 m", separation=30.0)
    expected = wake_of(35.8, 60e3, 70.0, 1.225)
    assert pair.separation == 30 and pair.core_radius == expected.core_radius
    assert pair.circulation == pytest.approx(expected.circulation, rel=1e-4)
    assert VortexPair.model_validate_json(pair.model_dump_json()) == pair


def test_an_unknown_type_is_refused():
    with pytest.raises(ValidationError, match=r"mass: not allowed without aircraft"):
        VortexPair(mass="60 t")
    with pytest.raises(ValidationError, match=r"'B797' is not allowed; expected one of A319, A320"):
        VortexPair(aircraft="B797")
