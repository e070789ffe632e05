"""Walking a straight line through nested media: transmittance and analog collisions."""

import drjit as dr
import mitsuba as mi


def interaction(medium, position, direction, wavelengths, time):
    """The medium interaction of light that arrives at ``position`` along ``direction``."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p = position
    mei.wi = -direction
    mei.sh_frame = mi.Frame3f(-direction)
    mei.medium = medium
    mei.wavelengths = wavelengths
    mei.time = time
    return mei


def coefficients(medium, mei, channel, active):
    """Scattering and extinction coefficient (m^-1) at an interaction."""
    scattering, _, extinction = medium.get_scattering_coefficients(mei, active)
    return scattering[channel], extinction[channel]


def transmittance(
    air,
    medium,
    origin,
    direction,
    distance,
    channel,
    wavelengths,
    time,
    rng,
    active,
    differentiable=False,
):
    """Unbiased estimate of the transmittance along a straight line, and the medium at its end.

    Homogeneous media in closed form; others by residual ratio tracking (Novak et al. 2014, ACM TOG
    33(6)), unbiased for any majorant that bounds the extinction coefficient.

    With ``differentiable``, gradients are unbiased too: d ln T, the integral of -d(extinction), is
    estimated at one uniform place of the line, independent of the estimate of T.
    """
    where = rng.next_float32(active) * distance if differentiable else mi.Float(-1)
    with dr.suspend_grad():
        value, end, between = _walk(
            air,
            medium,
            dr.detach(origin),
            dr.detach(direction),
            dr.detach(distance),
            where,
            channel,
            wavelengths,
            time,
            rng,
            active,
        )
    if differentiable:
        mei = interaction(between, origin + direction * where, direction, wavelengths, time)
        inside = active & (between != None)
        _, extinction = coefficients(between, mei, channel, inside)
        depth = dr.select(inside, extinction * distance, 0)
        value *= dr.exp(dr.detach(depth) - depth)
    return value, end


@dr.syntax
def _walk(air, medium, origin, direction, distance, where, channel, wavelengths, time, rng, active):
    """Transmittance, medium at the end, and medium at the distance ``where``."""
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    travelled, value = mi.Float(0), mi.Float(1)
    between = mi.MediumPtr(medium)
    crossings = air.crossings(origin, direction)
    while dr.hint(active, label="transmittance"):
        end, hit, passes, medium, behind = air.next_surface(
            crossings, origin, direction, travelled, distance, medium, active
        )
        between = dr.select(active & (travelled <= where), medium, between)
        inside = active & (medium != None)
        # control variate: the extinction in the middle of the segment; the remainder is tracked
        middle = origin + direction * (0.5 * (travelled + end))
        mei = interaction(medium, middle, direction, wavelengths, time)
        _, control = coefficients(medium, mei, channel, inside)
        value = dr.select(inside, value * dr.exp(-control * (end - travelled)), value)
        majorant = medium.get_majorant(mei, inside)[channel]
        tracking = inside & ~medium.is_homogeneous() & (majorant > 0)
        position = mi.Float(travelled)
        while dr.hint(tracking, label="ratio tracking"):
            position -= dr.log(1 - rng.next_float32(tracking)) / majorant
            tracking &= position < end
            mei = interaction(medium, origin + direction * position, direction, wavelengths, time)
            _, extinction = coefficients(medium, mei, channel, tracking)
            excess = (extinction - control) / majorant
            value = dr.select(tracking, value * (1 - excess), value)
        value = dr.select(hit & ~passes, 0, value)
        medium = dr.select(hit, behind, medium)
        travelled = end
        active &= hit & (value > 0)
    return value, medium, between


@dr.syntax
def collision(air, medium, origin, direction, distance, channel, wavelengths, time, rng, active):
    """Distance to the first real collision by delta tracking, its medium, and whether it happened.

    Not forced: a sample without a collision within ``distance``, or at an opaque surface, is lost.
    """
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    travelled = mi.Float(0)
    found = mi.Bool(False)
    crossings = air.crossings(origin, direction)
    while dr.hint(active, label="free flight"):
        end, hit, passes, medium, behind = air.next_surface(
            crossings, origin, direction, travelled, distance, medium, active
        )
        inside = active & (medium != None)
        mei = interaction(medium, origin + direction * travelled, direction, wavelengths, time)
        majorant = medium.get_majorant(mei, inside)[channel]
        tracking = inside & (majorant > 0)
        while dr.hint(tracking, label="delta tracking"):
            travelled -= dr.select(tracking, dr.log(1 - rng.next_float32(tracking)) / majorant, 0)
            tracking &= travelled < end
            mei = interaction(medium, origin + direction * travelled, direction, wavelengths, time)
            _, extinction = coefficients(medium, mei, channel, tracking)
            real = tracking & (rng.next_float32(tracking) * majorant < extinction)
            found |= real
            tracking &= ~real
        active &= ~found & hit & passes
        medium = dr.select(active, behind, medium)
        travelled = dr.select(found, travelled, end)
    return travelled, medium, found
