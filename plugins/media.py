"""Walking a straight line through nested media: transmittance and analog collisions."""

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from .bounds import UNIFORM, UNKNOWN, Bounds, leave, locate
from .polarization import level_frame
from .surfaces import Air
from .variant_types import Float, Generator, Interaction, Mask, Medium, MediumPtr, Point, Vector

# Optical depth along a segment by which the control variate may exceed the least extinction, and
# the majorant over the largest difference of extinction and control. Both only concern efficiency.
RAISED, MAJORANT = 0.5, 2.0


def interaction(
    medium: MediumPtr, position: Point, direction: Vector, wavelengths: Float, time: Float
) -> Interaction:
    """The medium interaction of light that arrives at ``position`` along ``direction``."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p = position
    mei.wi = -direction
    mei.sh_frame = level_frame(-direction)
    mei.medium = medium
    mei.wavelengths = wavelengths
    mei.time = time
    return mei


def coefficients(
    medium: MediumPtr, mei: Interaction, channel: int, active: Mask
) -> tuple[Float, Float]:
    """Scattering and extinction coefficient (m^-1) at an interaction."""
    scattering, _, extinction = medium.get_scattering_coefficients(mei, active)
    return scattering[channel], extinction[channel]


def narrowest_peak(media: Iterable[Medium], wavelengths: Float) -> Float:
    """The forward peak of the media's most forward-peaked phase function: a width of 1 - cos.

    It is the width of a cone of the peak's density that would contain all light; 2 for isotropic
    scattering. It only guides sampling: a phase function that varies is taken at the origin.
    """
    context, width = mi.PhaseFunctionContext(), 2.0
    onward, aside = mi.Vector3f(0, 0, 1), dr.normalize(mi.Vector3f(1e-3, 0, 1))
    with dr.suspend_grad():
        mei = interaction(dr.zeros(mi.MediumPtr), mi.Point3f(0), onward, wavelengths, mi.Float(0))
        for medium in media:
            _, density = medium.phase_function().eval_pdf(context, mei, aside)
            width = dr.minimum(width, dr.inv_two_pi / density)
    width = mi.Float(width)
    dr.make_opaque(width)
    return width


def transmittance(
    air: Air,
    bounds: Bounds,
    medium: MediumPtr,
    origin: Point,
    direction: Vector,
    distance: Float,
    channel: int,
    wavelengths: Float,
    time: Float,
    rng: Generator,
    active: Mask,
    differentiable: bool = False,
) -> tuple[Float, MediumPtr]:
    """Unbiased estimate of the transmittance along a straight line, and the medium at its end.

    Homogeneous media in closed form, others by residual ratio tracking (Novak et al. 2014, ACM TOG
    33(6)) in the blocks of ``bounds``. The control variate of a block is its mean extinction, but
    not so far above its least one that all blocks of a segment together exceed an optical depth of
    `RAISED`. No field makes the variance explode: over the squared mean it is at most
    exp((t + RAISED) / MAJORANT) - 1, with t the optical depth of what exceeds the control.

    With ``differentiable``, gradients are unbiased too: d ln T, the integral of -d(extinction), is
    estimated at one place of the line, independent of the estimate of T.
    """
    # a loop cannot be differentiated backwards without storing its states: the derivative is
    # estimated outside of it
    with dr.suspend_grad():
        value, end, place, between, length = _walk(
            air,
            bounds,
            medium,
            dr.detach(origin),
            dr.detach(direction),
            dr.detach(distance),
            channel,
            wavelengths,
            time,
            rng,
            active,
            differentiable,
        )
    if differentiable:
        mei = interaction(between, origin + direction * place, direction, wavelengths, time)
        inside = active & (between != None)
        _, extinction = coefficients(between, mei, channel, inside)
        depth = dr.select(inside, extinction * length, 0)
        # 1, whose derivative is that of -depth
        value *= dr.exp(dr.detach(depth) - depth)
    return value, end


@dr.syntax
def _walk(
    air: Air,
    bounds: Bounds,
    medium: MediumPtr,
    origin: Point,
    direction: Vector,
    distance: Float,
    channel: int,
    wavelengths: Float,
    time: Float,
    rng: Generator,
    active: Mask,
    chooses: bool,
) -> tuple[Float, MediumPtr, Float, MediumPtr, Float]:
    """Transmittance and medium at the end.

    With ``chooses`` also a random place in a medium, its medium, and the inverse of its density.
    That varies as the medium's majorant and, for the thin ones, an optical depth of 1 along the
    whole line.
    """
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    travelled, value = mi.Float(0), mi.Float(1)
    chosen, between, total, rate = mi.Float(0), dr.zeros(mi.MediumPtr), mi.Float(0), mi.Float(1)
    crossings = air.crossings(origin, direction)
    while dr.hint(active, label="transmittance"):
        end, hit, passes, medium, behind = air.next_surface(
            crossings, origin, direction, travelled, distance, medium, active
        )
        inside = active & (medium != None)
        kind = bounds.kind(medium)
        mei = interaction(medium, origin + direction * travelled, direction, wavelengths, time)
        if dr.hint(chooses, mode="scalar"):
            density = medium.get_majorant(mei, inside)[channel] + dr.rcp(distance)
            part = dr.select(inside, density * (end - travelled), 0)
            total += part
            takes = inside & (rng.next_float32(inside) * total < part)
            anywhere = dr.lerp(travelled, end, rng.next_float32(inside))
            chosen, rate = dr.select(takes, anywhere, chosen), dr.select(takes, density, rate)
            between = dr.select(takes, medium, between)
        # in closed form, without a random number
        uniform = inside & (kind == UNIFORM)
        _, extinction = coefficients(medium, mei, channel, uniform)
        depth = dr.select(uniform, extinction * (end - travelled), 0)
        # known when the kernel is recorded: without a varying medium there is no inner loop
        if dr.hint(bounds.varies, mode="scalar"):
            tracking = inside & ~uniform
            unknown = tracking & (kind == UNKNOWN)
            # a volume of another kind has no blocks: one majorant everywhere
            whole = medium.get_majorant(mei, unknown)[channel]
            start, step, counts, first = bounds.enter(medium, origin, direction)
            block = locate(start, step, counts, travelled)
            flight = -dr.log(1 - rng.next_float32(tracking))
            # per metre, so that the segment's excess over its least extinction is RAISED at most
            raised = RAISED / (end - travelled)
            while dr.hint(tracking, label="ratio tracking"):
                least, mean, most = bounds.extinction(block, counts, first)
                control = dr.minimum(mean, least + raised)
                # twice the largest difference: factors 1 - difference / majorant stay within 0.5
                # and 1.5, so that their product has a bounded variance and is never negative
                majorant = MAJORANT * dr.maximum(most - control, control - least)
                majorant = dr.select(unknown, whole, majorant)
                stop, onward = leave(start, step, counts, block)
                stop = dr.clip(stop, travelled, end)
                # in optical depths of the majorant, as is ``flight``: what is not used up in this
                # block goes on in the next, whose majorant is another one
                in_block = majorant * (stop - travelled)
                collides = tracking & (flight < in_block)
                place = dr.select(collides, travelled + flight / majorant, stop)
                depth += dr.select(tracking, control * (place - travelled), 0)
                mei = interaction(medium, origin + direction * place, direction, wavelengths, time)
                _, extinction = coefficients(medium, mei, channel, collides)
                value = dr.select(collides, value * (1 - (extinction - control) / majorant), value)
                flight = dr.select(
                    collides, -dr.log(1 - rng.next_float32(collides)), flight - in_block
                )
                block = dr.select(collides, block, onward)
                travelled = dr.select(tracking, place, travelled)
                # a product that is 0 stays 0
                tracking &= (value > 0) & (collides | (stop < end))
        value = dr.select(hit & ~passes, 0, value * dr.exp(-depth))
        medium = dr.select(hit, behind, medium)
        travelled = end
        active &= hit & (value > 0)
    return value, medium, chosen, between, total / rate


@dr.syntax
def collision(
    air: Air,
    bounds: Bounds,
    medium: MediumPtr,
    origin: Point,
    direction: Vector,
    distance: Float,
    channel: int,
    wavelengths: Float,
    time: Float,
    rng: Generator,
    active: Mask,
) -> tuple[Float, MediumPtr, Mask]:
    """Distance to the first real collision by delta tracking, its medium, and whether it happened.

    Not forced: a sample without a collision within ``distance``, or at an opaque surface, is lost.
    """
    active = mi.Bool(active)
    medium = mi.MediumPtr(medium)
    travelled = mi.Float(0)
    real_collision = mi.Bool(False)
    crossings = air.crossings(origin, direction)
    while dr.hint(active, label="free flight"):
        end, hit, passes, medium, behind = air.next_surface(
            crossings, origin, direction, travelled, distance, medium, active
        )
        # also through uniform media: samples are drawn from the physical distribution, which is
        # what the closed form of `transmittance` is validated against
        tracking = active & (medium != None)
        mei = interaction(medium, origin + direction * travelled, direction, wavelengths, time)
        blind = tracking & (bounds.kind(medium) <= UNIFORM)
        whole = medium.get_majorant(mei, blind)[channel]
        start, step, counts, first = bounds.enter(medium, origin, direction)
        block = locate(start, step, counts, travelled)
        flight = -dr.log(1 - rng.next_float32(tracking))
        while dr.hint(tracking, label="delta tracking"):
            majorant = dr.select(blind, whole, bounds.extinction(block, counts, first).z)
            stop, onward = leave(start, step, counts, block)
            stop = dr.clip(stop, travelled, end)
            in_block = majorant * (stop - travelled)
            collides = tracking & (flight < in_block)
            place = dr.select(collides, travelled + flight / majorant, stop)
            mei = interaction(medium, origin + direction * place, direction, wavelengths, time)
            _, extinction = coefficients(medium, mei, channel, collides)
            # the others are null collisions, behind which the flight goes on unchanged
            real = collides & (rng.next_float32(collides) * majorant < extinction)
            real_collision |= real
            flight = dr.select(collides, -dr.log(1 - rng.next_float32(collides)), flight - in_block)
            block = dr.select(collides, block, onward)
            travelled = dr.select(tracking, place, travelled)
            tracking &= ~real & (collides | (stop < end))
        active &= ~real_collision & hit & passes
        medium = dr.select(active, behind, medium)
        travelled = dr.select(real_collision, travelled, end)
    return travelled, medium, real_collision
