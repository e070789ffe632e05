"""Stokes vectors and Mueller matrices of single scattering, in Mitsuba's conventions.

A Stokes vector (I, Q, U, V) belongs to a propagation direction k and a reference axis
perpendicular to it; Q > 0 is linear polarisation along that axis. A phase function returns the
Mueller matrix from the axis ``mi.mueller.stokes_basis(k)`` of the incident light to
``mi.mueller.stokes_basis(k')`` of the scattered light, both in world coordinates.
"""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from .variant_types import Float, Frame, Medium, PhaseFunction, Spectrum, Stokes, Vector


def horizontal_axis(direction: Vector) -> Vector:
    """Horizontal unit vector perpendicular to ``direction``: the axis e_h of lidar Stokes vectors.

    For light straight up or down, where every perpendicular axis is horizontal, it is the y axis.
    """
    length = dr.hypot(direction.x, direction.y)
    vertical = length < 1e-6
    scale = dr.rcp(dr.select(vertical, 1, length))
    return dr.select(
        vertical, mi.Vector3f(0, 1, 0), mi.Vector3f(-direction.y * scale, direction.x * scale, 0)
    )


def level_frame(direction: Vector) -> Frame:
    """Axes (e_h, e_v, direction) about a direction. They turn with it, up to the vertical.

    Mitsuba's own axes about a direction change abruptly where it is horizontal: random numbers
    common to beams would there make other paths.
    """
    horizontal = horizontal_axis(direction)
    return mi.Frame3f(horizontal, dr.cross(direction, horizontal), direction)


def transverse(axis: Vector, direction: Vector) -> Vector:
    """Unit vector along the part of ``axis`` that is perpendicular to ``direction``."""
    return dr.normalize(axis - direction * dr.dot(axis, direction))


def scattering_angle(incident: Vector, scattered: Vector) -> Float:
    """Angle between two unit vectors, in radians, exact to rounding near 0 and 180 degrees."""
    return dr.atan2(dr.norm(dr.cross(incident, scattered)), dr.dot(incident, scattered))


def rotate_from_scattering_plane(
    incident: Vector, scattered: Vector, elements: Sequence[Float]
) -> Spectrum:
    """Mueller matrix between the Stokes bases of two directions from scattering-plane elements.

    Parameters
    ----------
    incident, scattered : mi.Vector3f
        Unit propagation directions k and k'.
    elements : tuple
        (a1, a2, a3, a4, b1, b2) of the matrix with rows (a1, b1, 0, 0), (b1, a2, 0, 0),
        (0, 0, a3, b2), (0, 0, -b2, a4), referred to the scattering plane (Hansen & Travis 1974,
        Space Sci. Rev. 16, eq. 2.23 ff.; Q > 0 is polarisation parallel to the plane).

    Notes
    -----
    At exactly 0 and 180 degrees the scattering plane is undefined; any plane through k then gives
    the same matrix, provided b1 = b2 = 0, a2 = +-a3 there, which every macroscopically isotropic
    and mirror-symmetric medium obeys.
    """
    a1, a2, a3, a4, b1, b2 = elements
    normal = dr.cross(incident, scattered)
    length = dr.norm(normal)
    defined = length > 1e-6
    normal = dr.select(
        defined, normal * dr.rcp(dr.select(defined, length, 1)), mi.coordinate_system(incident)[0]
    )
    plane = mi.Spectrum(0)
    plane[0, 0], plane[0, 1] = a1, b1
    plane[1, 0], plane[1, 1] = b1, a2
    plane[2, 2], plane[2, 3] = a3, b2
    plane[3, 2], plane[3, 3] = -b2, a4
    # (axis, normal, direction) is right-handed for both, as (e_h, e_v, direction) is.
    return mi.mueller.rotate_mueller_basis(
        plane,
        in_forward=incident,
        in_basis_current=dr.cross(normal, incident),
        in_basis_target=mi.mueller.stokes_basis(incident),
        out_forward=scattered,
        out_basis_current=dr.cross(normal, scattered),
        out_basis_target=mi.mueller.stokes_basis(scattered),
    )


def first_unpolarized_in_blend(medium: Medium) -> PhaseFunction | None:
    """The first scalar phase function of a medium that is blended with polarised ones, or None.

    Such a function (``hg``, ``isotropic``) returns a multiple of the unit matrix between any two
    axes. Alone it is recognised and depolarises; added to a Mueller matrix it cannot be
    recognised. None without a blend, or if all or none of its parts are polarised.
    """
    leaves = parts_of(medium.phase_function())
    if len(leaves) < 2 or not mi.is_polarized:
        return None
    scalar = [leaf for leaf in leaves if _is_scalar(leaf)]
    return scalar[0] if 0 < len(scalar) < len(leaves) else None


def parts_of(phase: PhaseFunction) -> list[PhaseFunction]:
    """The phase functions that a blend consists of; one that is no blend itself."""
    nested: list[PhaseFunction] = []

    class Nested(mi.TraversalCallback):
        def put(self, name: str, value: object, *_: object) -> None:
            if isinstance(value, mi.PhaseFunction):
                nested.append(value)

    phase.traverse(Nested())
    return [leaf for part in nested for leaf in parts_of(part)] or [phase]


def _is_scalar(phase: PhaseFunction) -> bool:
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.wi, mei.sh_frame = mi.Vector3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, -1))
    matrix, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, mi.Vector3f(1, 0, 0))
    diagonal = [matrix[i, i][0] for i in range(4)]
    return all(dr.all(element == diagonal[0]) for element in diagonal)


def rotate_stokes(
    stokes: Stokes, direction: Vector, current_axis: Vector, target_axis: Vector
) -> Stokes:
    """Stokes vector (4 arrays) of light along ``direction``, referred to another axis."""
    cosine = dr.dot(current_axis, target_axis)
    sine = dr.dot(dr.cross(current_axis, target_axis), direction)
    cos2, sin2 = cosine * cosine - sine * sine, 2 * cosine * sine
    i, q, u, v = stokes
    return [i, cos2 * q + sin2 * u, cos2 * u - sin2 * q, v]


def apply_phase_function(value: Spectrum, stokes: Stokes, channel: int) -> Stokes:
    """A phase function's value (Mueller matrix or number) times a Stokes vector."""
    if not mi.is_polarized:
        return [value[channel] * stokes[0]]
    matrix = [[value[row, column][channel] for column in range(4)] for row in range(4)]
    scattered = [sum(m * s for m, s in zip(row, stokes, strict=True)) for row in matrix]
    # scalar phase functions return a multiple of the unit matrix in *any* pair of axes
    scalar = matrix[0][0]
    depolarises = (matrix[0][1] == 0) & (matrix[1][0] == 0)
    depolarises &= (matrix[1][1] == scalar) & (matrix[2][2] == scalar) & (matrix[3][3] == scalar)
    return [scattered[0], *(dr.select(depolarises, 0, s) for s in scattered[1:])]
