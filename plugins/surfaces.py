"""Surfaces between media along a straight line, and the medium between two of them.

Shapes whose surface lets light pass unchanged (``null`` BSDF) separate media; any other surface is
opaque. What is inside of a closed shape is found anew for every part of a line: from both distances
at which the line crosses the shape, or, for a mesh, from the side from which it meets the shape
next. So it depends neither on the order of surfaces that touch nor on rounding, and no surface is
lost, however close behind another it lies. Where shapes overlap, the smallest one's medium holds.
"""

from collections.abc import Sequence
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from .bodies import (
    STEP,
    Body,
    Crossing,
    Line,
    Sheet,
    box_around,
    first_hit,
    name_of,
    parts_of_shape,
    passes_light,
    reflects,
    scene_of,
)
from .parameters import fail
from .variant_types import Float, Mask, Medium, MediumPtr, Point, Scene, Sensor, Vector

Crossings: TypeAlias = tuple[list[Line], Float | None]
"""Of a line: what each body needs to know of it, the distance of its first opaque surface."""

# m, beyond any air
FAR = 1e9


class Air:
    """A scene's media and the surfaces between them, seen by a sensor, or from a vacuum.

    Closed shapes are ``bodies``, from the largest to the smallest. A line's crossings of cubes and
    spheres are found in closed form; for any other shape rays are traced, to each shape alone:
    where surfaces coincide, a common search would find one of them. ``around`` is the medium
    outside of all bodies.

    Raises
    ------
    ValueError
        Sensor and shapes contradict each other about a medium.
    """

    def __init__(self, scene: Scene, sensor: Sensor | None = None) -> None:
        self.bodies: list[Body] = []
        self.sheets: list[Sheet] = []
        opaque = []
        self.low, self.high = box_around(scene.shapes())
        for shape in scene.shapes():
            if not passes_light(shape):
                opaque.append(shape)
            elif shape.is_medium_transition():
                for part in parts_of_shape(shape):
                    if isinstance(part, Sheet):
                        self.sheets.append(part)
                    else:
                        self.bodies.append(part)
        # the last body that a place is in is the smallest: its medium holds
        self.bodies.sort(key=lambda body: -body.volume)
        self.opaque = scene_of(opaque) if opaque else None
        targets = [shape for shape in opaque if reflects(shape)]
        self.targets: Scene = scene_of(targets) if targets else None
        around = _surroundings(self.bodies, self.sheets, sensor) if sensor else None
        self.around = mi.MediumPtr(around)
        for body in self.bodies:
            # a cavity that states no medium is open to what surrounds all shapes
            if body.hollow and body.interior is None:
                body.inside = self.around
        dr.make_opaque(self.around)
        # an open surface encloses nothing: behind it there may be air at any distance
        self.bounds = self.low, self.high
        if around is not None or self.sheets:
            self.bounds = dr.opaque(mi.Point3f, -FAR), dr.opaque(mi.Point3f, FAR)

    def crossings(self, origin: Point, direction: Vector) -> Crossings:
        """Crossings of each body with a line, and the distance of the first opaque surface."""
        lines = [body.line(origin, direction) for body in self.bodies]
        if self.opaque is None:
            return lines, None
        return lines, first_hit(self.opaque, origin, direction, mi.Bool(True))[0]

    def next_surface(
        self,
        crossings: Crossings,
        origin: Point,
        direction: Vector,
        start: Float,
        distance: Float,
        medium: MediumPtr,
        active: Mask,
    ) -> tuple[Float, Mask, Mask, MediumPtr, MediumPtr]:
        """The part of a line that begins at the distance ``start``.

        Returns its end, whether a surface is there, whether light passes that surface, the medium
        of this part, and what to hand over as ``medium`` for the next one.
        """
        active = active & (start < distance)
        lines, opaque = crossings
        end = mi.Float(distance)
        # only open surfaces change it on the way; a body's medium follows from the body alone
        around = mi.MediumPtr(medium) if self.sheets else self.around
        within = []
        for body, line in zip(self.bodies, lines, strict=True):
            place, inside = body.next_crossing(line, origin, direction, start, active)
            end = dr.minimum(end, place)
            within.append(inside)
        if self.sheets:
            # outside of the largest body
            for body, inside in zip(self.bodies[::-1], within[::-1], strict=True):
                around = dr.select(inside, body.outside, around)
        part_medium = around
        for body, inside in zip(self.bodies, within, strict=True):
            part_medium = dr.select(inside, body.inside, part_medium)
        if self.sheets:
            end, around = self._sheets(origin, direction, start, end, around, active)
        passes = mi.Bool(True)
        if self.opaque is not None:
            passes = ~((opaque > start) & (opaque <= end))
            end = dr.select(passes, end, dr.minimum(opaque, end))
        return end, active & (end < distance), passes, mi.MediumPtr(part_medium), around

    def _sheets(
        self,
        origin: Point,
        direction: Vector,
        start: Float,
        end: Float,
        medium: MediumPtr,
        active: Mask,
    ) -> tuple[Float, MediumPtr]:
        """The same end, or that at an open surface, and the medium behind.

        Among surfaces that coincide within rounding, light first crosses the one whose front medium
        it is in: the last is the one whose back medium is in front of no other.
        """
        crossings = [sheet.next_crossing(origin, direction, start, active) for sheet in self.sheets]
        for place, _, _ in crossings:
            end = dr.minimum(end, place)
        # all that the next search may miss, and more
        slack = 2 * STEP * (dr.max(dr.abs(origin)) + end)
        at = [place <= end + slack for place, _, _ in crossings]
        behind = mi.MediumPtr(medium)
        for i, (_, front, back) in enumerate(crossings):
            last = mi.Bool(at[i])
            for j, (_, other_front, _) in enumerate(crossings):
                if i != j:
                    last &= ~(at[j] & (other_front == back))
            # left already where surfaces overlap: the medium in front of it is another one
            last &= (front == medium) | (front == None) | _any(at, crossings, i, front)
            behind = dr.select(last, back, behind)
        return end, behind


def _any(at: Sequence[Mask], crossings: Sequence[Crossing], index: int, front: MediumPtr) -> Mask:
    """Whether another of the surfaces that coincide ends at the medium ``front``."""
    result = mi.Bool(False)
    for j, (_, _, back) in enumerate(crossings):
        if j != index:
            result |= at[j] & (back == front)
    return result


def media_of(scene: Scene, sensor: Sensor) -> dict[Medium, str]:
    """All media of a scene and of the sensor in it, each with what a message calls it."""
    media = {}
    if sensor.get_medium() is not None:
        media[sensor.get_medium()] = name_of(sensor.get_medium())
    for shape in scene.shapes():
        for side in ("interior_medium", "exterior_medium"):
            medium = getattr(shape, side)()
            if medium is not None:
                media.setdefault(medium, f"{name_of(shape)}.{side}")
    return media


def _surroundings(bodies: list[Body], sheets: list[Sheet], sensor: Sensor) -> Medium | None:
    """The medium outside of all closed shapes, as sensor and shapes state it."""
    stated, places = sensor.get_medium(), sensor.places
    # of every beam: the largest and the smallest body in which it begins, -1 if in none
    outer, inner = (np.full(len(places), -1) for _ in range(2))
    for index, body in enumerate(bodies):
        inside = body.contains(places)
        outer[inside & (outer < 0)] = index
        inner[inside] = index
    if dr.any(sensor.laser.m_pose.translation() != 0):
        lasers = sensor.laser_places()
        for body in bodies:
            if (body.contains(lasers) != body.contains(places)).any():
                expected = f"a place on the telescope's side of {name_of(body.shape)}"
                fail("laser", "to_world", sensor.laser.m_pose.translation(), expected)
    for index in np.unique(inner[inner >= 0]):
        if stated is not None and stated != bodies[index].interior:
            fail(
                "scanning_lidar",
                "medium",
                name_of(stated),
                f"the medium of {name_of(bodies[index].shape)}, in which the telescope is, "
                "by reference",
            )
    # -1, of beams that begin in no body, is the last
    around = [*(body.exterior for body in bodies), stated]
    around = list(dict.fromkeys(around[index] for index in np.unique(outer)))
    if len(around) > 1:
        names = [medium and name_of(medium) for medium in around]
        fail("scanning_lidar", "medium", names, "one medium around the shapes for all beams")
    if sheets:
        light = np.array([*(body.interior for body in bodies), stated], object)[inner]
        _check_fronts(bodies, sheets, sensor, light)
    media = {around[0], None, *(body.interior for body in bodies)}
    media |= {medium for sheet in sheets for medium in (sheet.interior, sheet.exterior)}
    for body in bodies:
        if body.exterior not in media:
            fail(
                name_of(body.shape),
                "exterior",
                name_of(body.exterior),
                "by reference, the sensor's medium or that of a shape around or beside it",
            )
    return around[0]


def _check_fronts(
    bodies: list[Body], sheets: list[Sheet], sensor: Sensor, light: np.ndarray
) -> None:
    """Refuse open surfaces on whose near side is another medium than ``light``, that of beams."""
    origin, axis = (vectors.T.astype(np.float32) for vectors in sensor.beam_axes())
    origin, axis = mi.Point3f(*origin), mi.Vector3f(*axis)
    start, every = mi.Float(0), mi.Bool(True)
    first = mi.Float(dr.inf)
    for body in bodies:
        first = dr.minimum(
            first, body.next_crossing(body.line(origin, axis), origin, axis, start, every)[0]
        )
    crossings = [sheet.next_crossing(origin, axis, start, every) for sheet in sheets]
    for place, _, _ in crossings:
        first = dr.minimum(first, place)
    light = np.resize(light, dr.width(axis))
    for sheet, (place, front, _) in zip(sheets, crossings, strict=True):
        met_first = (place == first) & (place < dr.inf)
        for side, medium, pointer in (
            ("interior", sheet.interior, sheet.inside),
            ("exterior", sheet.exterior, sheet.outside),
        ):
            meets = np.resize(np.array(met_first & (front == pointer)), len(light))
            if medium is not None and any(arriving != medium for arriving in light[meets]):
                fail(
                    name_of(sheet.shape),
                    side,
                    name_of(medium),
                    "behind this surface, as light of the telescope comes from another medium",
                )
