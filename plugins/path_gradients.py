"""Derivatives of the light of all scattering orders, in memory that does not grow with them.

Positions, directions, Russian roulette and the selection of candidates are kept as they were drawn:
only the product of transmittances, coefficients and phase functions along a path is differentiated.
A path is traced twice with the same random numbers. The first time gives the light R of all orders
that are still to come, the second time the derivatives: at each vertex R times that of ln(T sigma),
which involves no earlier one (path replay, Vicini et al. 2021, ACM TOG 40(4), article 108).
"""

import drjit as dr
import mitsuba as mi

from . import path_sampling
from .media import coefficients, interaction, transmittance
from .variant_types import Float, Mask, Stokes, UInt

Sums = tuple[Stokes, Stokes]
"""Of the orders of a path: light, and light that a vertex without scattering would give, were its
coefficient the largest one of its medium."""


def gradients(
    lidar: "path_sampling.Lidar",
    sample: "path_sampling.Sample",
    low: Float,
    high: Float,
    orders: tuple[int, int],
    weights: Stokes | None = None,
) -> Stokes:
    """Gradients of samples' Stokes vectors, or of the scene from theirs.

    Parameters
    ----------
    low, high : Float
        Ends of the gate as whole paths, less the sample's delay, m.
    orders : (int, int)
        The lowest and the highest one that counts.
    weights : list of Float, optional
        Gradients of the Stokes vector, for the scene's (reverse mode); without, the scene has
        gradients (forward mode).

    Returns
    -------
    list of Float
        The Stokes vector's gradients; zeros in reverse mode.
    """
    first, last = orders
    position = sample.rng.next_float32()
    path, width, slopes = dr.lerp(low, high, position), high - low, [mi.Float(0)] * 4
    if first == 1:
        # Mitsuba's derivatives call this with gradients suspended
        with dr.resume_grad():
            slopes = _propagated(lidar.single(sample, path, width), weights)
    if last > 1:
        first, last = (dr.opaque(mi.UInt32, order) for order in orders)
        with dr.suspend_grad():
            coming, _ = _traced(lidar, sample, path, width, first, last)
            _, more = _traced(lidar, sample, path, width, first, last, coming, weights)
        slopes = _plus(slopes, more)
    return slopes


@dr.syntax
def _traced(
    lidar: "path_sampling.Lidar",
    sample: "path_sampling.Sample",
    path: Float,
    width: Float,
    first: UInt,
    last: UInt,
    coming: Sums | None = None,
    weights: Stokes | None = None,
) -> tuple[Sums, Stokes]:
    """One walk along the paths: the sums of their light, and with ``coming`` their derivatives."""
    replays = coming is not None
    rng, channel = mi.PCG32(sample.rng), lidar.channel
    light, hidden, slopes = ([mi.Float(0) for _ in range(4)] for _ in range(3))
    left, veiled = ([mi.Float(s) for s in part] for part in coming or (light, hidden))
    order, missing = mi.UInt32(2), mi.UInt32(0)
    path, medium = mi.Float(path), mi.MediumPtr(lidar.sensor.get_medium())
    position, direction = mi.Point3f(sample.origin), mi.Vector3f(sample.direction)
    stokes = [mi.Float(s) for s in sample.stokes]
    flight, weight = lidar._first_flight(rng, position, direction, sample.aperture, path)
    active = flight > 0
    while dr.hint(active, label="path replay"):
        # what is drawn stays where it is
        with dr.resume_grad(when=replays):
            out, medium = transmittance(
                lidar.air,
                lidar.bounds,
                medium,
                position,
                direction,
                flight,
                channel,
                lidar.wavelengths,
                sample.time,
                rng,
                active,
                True,
            )
            active &= medium != None
            position = mi.Point3f(position + direction * flight)
            mei = interaction(medium, position, direction, lidar.wavelengths, sample.time)
            scattering, _ = coefficients(medium, mei, channel, active)
        most = dr.detach(medium.get_majorant(mei, active)[channel])
        passed, scattered = dr.detach(out), dr.detach(scattering)
        # a place that does not scatter has a derivative: the path goes on as if it did
        dark = active & (scattered == 0)
        instead = dr.select(dark, most, scattered)
        before = missing == 0
        missing += dr.select(dark, mi.UInt32(1), 0)
        # by the largest coefficient: where there is little scattering, its derivative is as large
        likely = weight * passed * most
        weight *= passed * instead
        survival = dr.select(order == 2, 1, dr.minimum(path_sampling.ROULETTE_FACTOR * likely, 1))
        active &= (weight > 0) & (missing < 2) & (rng.next_float32(active) < survival)
        stokes = [s * dr.select(active, weight / survival, 0) for s in stokes]
        path -= flight
        here = mi.Bool(active)
        with dr.resume_grad(when=replays):
            rest, gain, active = lidar._close(sample, rng, medium, mei, stokes, path, width, active)
            counts = active & (order >= first)
            gain = _where(counts, gain)
            if dr.hint(replays, mode="scalar"):
                relative = dr.select(here & before, out / dr.select(passed > 0, passed, 1), 0)
                gained = dr.select(here & before, scattering / dr.select(here, instead, 1), 0)
                terms = _where(missing == 0, gain)
                terms = _plus(terms, _times(veiled, dr.select(dark, gained, 0)))
                terms = _plus(terms, _times(left, dr.select(dark, 0, relative + gained)))
                slopes = _plus(slopes, _propagated(terms, weights))
        gain = dr.detach(gain)
        seen = _where(missing == 0, gain)
        light, left = _plus(light, seen), _plus(left, _times(seen, -1))
        hidden = _plus(hidden, _where(missing == 1, gain))
        order += 1
        active &= order <= last
        direction, stokes, flight, weight = lidar._next_flight(
            rng, medium, mei, stokes, rest, active
        )
        active &= weight > 0
    return (light, hidden), slopes


def _propagated(terms: Stokes, weights: Stokes | None) -> Stokes:
    """Gradients of a Stokes vector; with ``weights`` they go to the scene, and zeros are left."""
    if not dr.grad_enabled(terms):
        return [mi.Float(0) for _ in terms]
    if weights is None:
        return list(dr.forward_to(terms))
    dr.backward_from(sum(w * t for w, t in zip(weights, terms, strict=True)))
    return [mi.Float(0) for _ in terms]


def _plus(first: Stokes, second: Stokes) -> Stokes:
    return [a + b for a, b in zip(first, second, strict=True)]


def _times(stokes: Stokes, factor: Float) -> Stokes:
    return [s * factor for s in stokes]


def _where(condition: Mask, stokes: Stokes) -> Stokes:
    return [dr.select(condition, s, 0) for s in stokes]
