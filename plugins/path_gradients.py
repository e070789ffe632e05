"""Derivatives of the light of all scattering orders, in memory that does not grow with them.

Positions, directions, Russian roulette and the selection of candidates are kept as they were drawn:
only the product of transmittances, coefficients and phase functions along a path is differentiated.
A path is traced twice with the same random numbers (path replay, Vicini et al. 2021, ACM TOG 40(4),
article 108). The first time gives the light R of all orders that are still to come, the second time
the derivatives: at each vertex R times that of ln(T sigma), which involves no earlier one.

Mueller matrices have no such logarithm. Of those at which a path may go on, one is drawn, and the
first walk also carries four Stokes vectors from there on: what it does to each component of light.
"""

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from . import path_sampling
from .media import coefficients, interaction, transmittance
from .variant_types import Float, Mask, MediumPtr, Point, Stokes, UInt, Vector


class ScatteringVertex(NamedTuple):
    """A vertex at which a path goes on: place, both directions and the light that arrives.

    ``onward`` are the Stokes vectors at the telescope of light of one component that leaves it.
    """

    medium: MediumPtr
    place: Point
    before: Vector
    after: Vector
    stokes: Stokes
    onward: list[Stokes]


def gradients(
    lidar: "path_sampling.Lidar",
    sample: "path_sampling.Sample",
    low: Float,
    high: Float,
    orders: tuple[int, int],
    phases: bool,
    weights: Stokes | None = None,
) -> Stokes:
    """Gradients of samples' Stokes vectors, or of the scene from theirs.

    Parameters
    ----------
    low, high : Float
        Ends of the gate as whole paths, less the sample's delay, m.
    orders : (int, int)
        The lowest and the highest one that counts.
    phases : bool
        Whether those of phase functions are wanted.
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
            light = lidar.single(sample, path, width)
            if lidar.air.targets:
                light = _plus(light, lidar.reflected(sample, low, high))
            slopes = _propagated(light, weights)
    if last == 1:
        return slopes
    least, most = (dr.opaque(mi.UInt32, order) for order in orders)
    # phase matrices at which paths go on, one for each order above two
    count, chosen = last - 2 if phases else 0, None
    if count:
        chosen = 2 + dr.minimum(mi.UInt32(sample.rng.next_float32() * count), count - 1)
    with dr.suspend_grad():
        coming, hidden, _, vertex = _traced(lidar, sample, path, width, least, most, chosen=chosen)
        *_, more, _ = _traced(
            lidar, sample, path, width, least, most, coming, hidden, weights, replays=True
        )
    slopes = _plus(slopes, more)
    if count:
        with dr.resume_grad():
            terms = [count * term for term in _light_of_vertex(lidar, sample, vertex)]
            slopes = _plus(slopes, _propagated(terms, weights))
    return slopes


@dr.syntax
def _traced(
    lidar: "path_sampling.Lidar",
    sample: "path_sampling.Sample",
    path: Float,
    width: Float,
    first: UInt,
    last: UInt,
    coming: Stokes | None = None,
    hidden: Stokes | None = None,
    weights: Stokes | None = None,
    chosen: UInt | None = None,
    replays: bool = False,
) -> tuple[Stokes, Stokes, Stokes, ScatteringVertex | None]:
    """One walk along the paths: the sums of their light, or its remainder after a replay.

    ``coming`` is light, ``hidden`` light that a single vertex without scattering would give, were
    its coefficient the largest one of its medium. A replay also gives the derivatives, ``chosen``
    the vertex at which a path goes on to this order.
    """
    rng, channel, tracks = mi.PCG32(sample.rng), lidar.channel, chosen is not None
    light, veiled = (_copied(s or [0] * 4) for s in (coming, hidden))
    slopes = _copied([0] * 4)
    order, missing = mi.UInt32(2), mi.UInt32(0)
    medium = mi.MediumPtr(lidar.sensor.get_medium())
    position, direction = mi.Point3f(sample.origin), mi.Vector3f(sample.direction)
    stokes = _copied(sample.stokes)
    # the order of the chosen vertex's flight, and the components of light from there on
    following = 0 if chosen is None else chosen + 1
    components = len(stokes) if tracks else 0
    parts = [_copied([0] * components) for _ in range(components)]
    onward = [_copied([0] * 4) for _ in range(components)]
    vertex_medium, vertex_place = mi.MediumPtr(medium), mi.Point3f(position)
    before = mi.Vector3f(direction)
    after, arriving = mi.Vector3f(direction), _copied([0] * len(stokes))
    flight, excess, weight = lidar._first_flight(rng, position, direction, sample.aperture, path)
    active = flight > 0
    while dr.hint(active, label="path replay"):
        # samples are not differentiated
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
        clear = missing == 0
        missing += dr.select(dark, mi.UInt32(1), 0)
        # by the majorant: where there is little scattering, its derivative is as large
        likely = weight * passed * most
        weight *= passed * instead
        survival = dr.select(order == 2, 1, dr.minimum(path_sampling.ROULETTE_FACTOR * likely, 1))
        active &= (weight > 0) & (missing < 2) & (rng.next_float32(active) < survival)
        weight = dr.select(active, weight / survival, 0)
        stokes, parts = _times(stokes, weight), _each_times(parts, weight)
        clear &= active
        with dr.resume_grad(when=replays):
            open_path, gains, active = lidar._close(
                sample, rng, medium, mei, stokes, excess, width, active, parts
            )
            counts = active & (order >= first)
            gain = _where(counts, gains[0])
            if dr.hint(replays, mode="scalar"):
                relative = dr.select(clear, out / dr.select(passed > 0, passed, 1), 0)
                gained = dr.select(clear, scattering / dr.select(clear, instead, 1), 0)
                terms = _where(missing == 0, gain)
                terms = _plus(terms, _times(veiled, dr.select(dark, gained, 0)))
                terms = _plus(terms, _times(light, dr.select(dark, 0, relative + gained)))
                slopes = _plus(slopes, _propagated(terms, weights))
        sign = -1 if replays else 1
        gain = dr.detach(gain)
        light = _plus(light, _times(_where(missing == 0, gain), sign))
        if dr.hint(not replays, mode="scalar"):
            veiled = _plus(veiled, _where(missing == 1, gain))
        if dr.hint(tracks, mode="scalar"):
            onward = _each_plus(onward, gains[1:], counts & (missing == 0))
        arrived = stokes
        order += 1
        active &= order <= last
        direction, stokes, flight, excess, weight = lidar._next_flight(
            rng, medium, mei, stokes, open_path, active
        )
        active &= weight > 0
        if dr.hint(tracks, mode="scalar"):
            # as the light itself, whose S0 a flight leaves unchanged
            several, _ = lidar._scatter_all(medium, mei, [arrived, *parts], direction, active)
            factor = dr.select(active, arrived[0] / several[0][0], 0)
            at_vertex = active & (order == following)
            parts = _each_times(several[1:], factor)
            parts = _each_where(at_vertex, _each_times(_unit(components), factor), parts)
            vertex_medium = dr.select(at_vertex, medium, vertex_medium)
            vertex_place = dr.select(at_vertex, position, vertex_place)
            before = dr.select(at_vertex, -mei.wi, before)
            after = dr.select(at_vertex, direction, after)
            arriving = _each_where(at_vertex, [arrived], [arriving])[0]
    vertex = vertex_medium, vertex_place, before, after, arriving, onward
    return light, veiled, slopes, ScatteringVertex(*vertex) if tracks else None


def _light_of_vertex(
    lidar: "path_sampling.Lidar", sample: "path_sampling.Sample", vertex: ScatteringVertex
) -> Stokes:
    """Stokes vector at the telescope of the light that goes on at a vertex."""
    mei = interaction(vertex.medium, vertex.place, vertex.before, lidar.wavelengths, sample.time)
    active = (vertex.stokes[0] > 0) & (vertex.medium != None)
    scattered, _ = lidar._scatter(vertex.medium, mei, vertex.stokes, vertex.after, active)
    terms = _copied([0] * 4)
    for part, onward in zip(scattered, vertex.onward, strict=True):
        terms = _plus(terms, _times(onward, dr.select(active, part, 0)))
    return terms


def _propagated(terms: Stokes, weights: Stokes | None) -> Stokes:
    """Gradients of a Stokes vector; with ``weights`` they go to the scene, and zeros are left."""
    if not dr.grad_enabled(terms):
        return _copied([0] * 4)
    # a walk is one of several that differentiate the same scene: what its values follow from, or
    # their gradients, are needed again
    if weights is None:
        return list(dr.forward_to(terms, flags=dr.ADFlag.ClearEdges))
    total = sum(w * t for w, t in zip(weights, terms, strict=True))
    dr.backward_from(total, flags=dr.ADFlag.ClearInterior)
    return _copied([0] * 4)


def _copied(stokes: Stokes | list[int]) -> Stokes:
    return [mi.Float(s) for s in stokes]


def _unit(components: int) -> list[Stokes]:
    """Light of one component each."""
    return [[mi.Float(i == k) for i in range(components)] for k in range(components)]


def _plus(first: Stokes, second: Stokes) -> Stokes:
    return [a + b for a, b in zip(first, second, strict=True)]


def _times(stokes: Stokes, factor: Float) -> Stokes:
    return [s * factor for s in stokes]


def _where(condition: Mask, stokes: Stokes) -> Stokes:
    return [dr.select(condition, s, 0) for s in stokes]


def _each_times(several: list[Stokes], factor: Float) -> list[Stokes]:
    return [_times(stokes, factor) for stokes in several]


def _each_plus(several: list[Stokes], more: list[Stokes], condition: Mask) -> list[Stokes]:
    return [_plus(a, _where(condition, b)) for a, b in zip(several, more, strict=True)]


def _each_where(condition: Mask, several: list[Stokes], otherwise: list[Stokes]) -> list[Stokes]:
    return [
        [dr.select(condition, a, b) for a, b in zip(new, old, strict=True)]
        for new, old in zip(several, otherwise, strict=True)
    ]
