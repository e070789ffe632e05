"""
.. _bsdf-etalon:

Fabry-Perot etalon (``etalon``)
-------------------------------

Two plane mirrors and the gap between them as one surface. Light is transmitted without deflection
at the frequencies and angles at which the waves of all round trips interfere constructively; the
remaining light is reflected. Frequencies are *offsets* from a laser line. The integer part of the
order of the gap is subtracted in double precision, so that float32 resolves the remainder (2e-6
orders within 1 degree of the axis, 0.004 m/s at 355 nm).

============================ ======= ====================================================== ========
Parameter                    Type    Meaning                                                Default
============================ ======= ====================================================== ========
``gap``                      float   mean distance of the mirrors, m                        13.7e-3
``order_fraction``           float   fractional order on the axis, mirrors included, to     that of
                                     which the gap is tuned by at most half an order        ``gap``
``index``                    float   refractive index in the gap                            1
``reflectivity``             float   of a mirror, for any angle and polarisation            0.7
``coating``                  string  instead of ``reflectivity``: layers of a mirror from   none
                                     its plate to the gap, each as "index thickness" (m) or
                                     "index thickness extinction", separated by commas:
                                     "2.1 42e-9, 1.48 60e-9"
``plate_index``              float   refractive index of the plates under a ``coating``     1.4761
``absorption``               float   fraction absorbed by a mirror, which reduces its       0
                                     transmission
``surface_rms``              float   Gaussian defects: rms deviation of the gap, m          0
``bow``                      float   spherical defect: difference of the gap between middle 0
                                     and edge of the clear aperture, m
``wavelength``               float   of the laser line, m                                   the
                                                                                            line's
``line_shape``               string  ``folded``: mean over the nested line, all defects and folded
                                     the whole aperture, analytically; ``sampled``: the
                                     frequency of the ray and one place on the plates
*(nested)*                   texture the :ref:`line <texture-spectral_line>`; required if   none
                                     folded
============================ ======= ====================================================== ========

Transmitted (component 1, ``Null``) and reflected light (component 0) have Mueller matrices with s
and p components and their phases. The outer faces of the plates are assumed to be coated and
wedged, so that their reflections are not received. A coating applies to both mirrors and is
computed for the laser line at the angle of the ray (transfer matrices); its dispersion is included
as the delay of a reflection on the axis. The walk-off of 2 ``gap`` tan(angle) per round trip, 0.4
mm at 15 mrad, is neglected; it is small compared with an aperture of a few cm. With a gap of index
n light is refracted by Snell's law from air of index 1.

With ``sampled`` the ``time`` of a ray contains its frequency offset from the laser line in Hz,
which the :ref:`fringes <integrator-fringes>` integrator sets; use it for several etalons in a row.
``folded`` uses the width of the line on the axis: widths are then wrong by 1 - cos(angle), 1e-4 at
15 mrad. ``gap`` and ``order_fraction`` (in double precision), ``surface_rms``, ``bow`` and, without
a coating, ``reflectivity`` and ``absorption`` can be changed through ``mi.traverse``; a new
``order_fraction`` tunes the gap again. These parameters and the line can also differ between scenes
of the same structure. Neither causes a recompilation.

.. code-block:: xml

    <bsdf type="etalon">
      <float name="gap" value="13.7e-3"/> <float name="order_fraction" value="0.5"/>
      <float name="reflectivity" value="0.7"/> <float name="surface_rms" value="2e-9"/>
      <texture type="spectral_line"/>
    </bsdf>
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from .coating import admittance, amplitudes_of, read_coating
from .parameters import TINY, at_least, choice, fail, number, positive
from .registration import register
from .variant_types import (
    Complex,
    Context,
    Drawn,
    Float,
    Int,
    Interaction,
    Mask,
    Point,
    Properties,
    Spectrum,
    Texture,
    Traversal,
    Vector,
)

NAME, KIND = "etalon", "bsdf"

Mirrors: TypeAlias = tuple[Complex, Complex, Complex]
"""Amplitudes for one polarisation: reflection on the side of the gap, transmission through both
mirrors, reflection on the outer side."""
Wave: TypeAlias = tuple[Complex, Complex, Complex, Complex, Complex]
"""The amplitudes of `Mirrors`, the factor of a round trip, and the mean of the sum of all trips."""
Elements: TypeAlias = tuple[Float, Float, Float, Float]
"""Elements m00, m01, m22, m23 of a Mueller matrix about the axis perpendicular to the plane of
incidence."""

SPEED_OF_LIGHT = 299_792_458.0
# what mi.traverse shows
CHANGEABLE = ("gap", "order_fraction", "reflectivity", "absorption", "surface_rms", "bow")
# relative amplitude of the neglected harmonics of a folded line
NEGLECTED = 1e-8
# transmittance below which a mirror counts as opaque
LEAST_PASSED = 1e-6


def define() -> type:
    """The plugin's class in the variant in force."""

    class Etalon(mi.BSDF):
        def __init__(self, props: Properties) -> None:
            super().__init__(props)
            lines = [o for _, o in props.objects() if hasattr(o, "characteristic")]
            if len(lines) > 1:
                fail(NAME, "line", len(lines), "one nested texture of type 'spectral_line'")
            # None only where frequencies are sampled
            self.line: Texture = lines[0] if lines else None
            self.line_shape = choice(props, NAME, "line_shape", "folded", ("folded", "sampled"))
            if self.line_shape == "folded" and self.line is None:
                fail(NAME, "line", None, "a nested texture of type 'spectral_line', or 'sampled'")
            expected = self.line.wavelength if self.line else 354.7e-9
            self.wavelength = positive(props, NAME, "wavelength", expected)
            self.index = at_least(props, NAME, "index", 1.0, 1.0)
            self.gap = positive(props, NAME, "gap", 13.7e-3)
            self.order_fraction = number(props, NAME, "order_fraction", 0.0)
            tuned = "order_fraction" in props
            self.absorption = at_least(props, NAME, "absorption", 0.0, 0.0)
            self.surface_rms = at_least(props, NAME, "surface_rms", 0.0, 0.0)
            self.bow = number(props, NAME, "bow", 0.0)
            self.plate_index = at_least(props, NAME, "plate_index", 1.4761, 1.0)
            self.coating = read_coating(props, NAME)
            self.reflectivity = number(props, NAME, "reflectivity", 0.7)
            for field in ("reflectivity", "absorption"):
                if self.coating and field in props:
                    fail(NAME, field, props[field], "either it or a coating")
            self._prepare(tuned)
            fixed = ("reflectivity", "absorption") if self.coating else ()
            # single precision would round the order of the gap
            self.m_changeable = {
                name: mi.Float64(getattr(self, name)) for name in CHANGEABLE if name not in fixed
            }
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DeltaReflection | sides, mi.BSDFFlags.Null | sides]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _prepare(self, tuned: bool) -> None:
            """Quantities in double precision; ``tuned``: to the fraction of the order."""
            for field, least in (("gap", TINY), ("absorption", 0.0), ("surface_rms", 0.0)):
                if not least <= getattr(self, field) < np.inf:
                    allowed = f"a finite number, {least:g} or more"
                    fail(NAME, field, getattr(self, field), allowed)
            if not np.isfinite(self.bow):
                fail(NAME, "bow", self.bow, "a finite number")
            if not 0 <= self.order_fraction < 1:
                fail(NAME, "order_fraction", self.order_fraction, "0 <= value < 1")
            delay, shift = 0.0, 0.0  # of a reflection at a coating: s, half orders
            if self.coating:
                axial, passed, _ = self._mirror_on_axis(1.0)
                self.reflectivity = float(abs(axial) ** 2)
                if not abs(passed) > LEAST_PASSED:
                    opaque = f"transmittance {abs(passed):.1e}"
                    fail(NAME, "coating", opaque, f"above {LEAST_PASSED:g}")
                shift = np.angle(axial) / np.pi
                step = 1e-6
                above, below = (self._mirror_on_axis(1 + h)[0] for h in (step, -step))
                change = np.angle(above / below)
                delay = change / (2 * step) * self.wavelength / (2 * np.pi * SPEED_OF_LIGHT)
            self.order = 2 * self.index * self.gap / self.wavelength
            if tuned:
                difference = self.order + shift - self.order_fraction
                self.order += round(difference) - difference
                self.gap = self.order * self.wavelength / (2 * self.index)
            self.order_on_axis = self.order + shift
            if not tuned:
                self.order_fraction = float(self.order_on_axis % 1)
            if not 0 < self.reflectivity < 1:
                fail(NAME, "reflectivity", self.reflectivity, "a number between 0 and 1")
            passed = 1 - self.reflectivity
            if not passed - self.absorption > LEAST_PASSED:
                fail(
                    NAME, "absorption", self.absorption, f"less than 1 - reflectivity = {passed:g}"
                )
            per_hertz = float(2 * self.index * self.gap / SPEED_OF_LIGHT + 2 * delay)
            self.free_spectral_range = 1 / per_hertz
            self.m_fraction = dr.opaque(mi.Float, self.order - round(self.order))
            self.m_order = dr.opaque(mi.Float, self.order)
            self.m_orders_per_hertz = dr.opaque(mi.Float, per_hertz)
            self.m_reflectivity = dr.opaque(mi.Float, self.reflectivity)
            # factor of the transmitted amplitude by absorption, for two mirrors
            self.m_passed = dr.opaque(mi.Float, 1 - self.absorption / passed)
            self.m_defect_order = 2 * self.index / self.wavelength
            self.m_rms = dr.opaque(mi.Float, self.surface_rms * self.m_defect_order)
            self.m_bow = dr.opaque(mi.Float, self.bow * self.m_defect_order)
            if self.line_shape == "folded":
                # a coating reflects more at other angles and polarisations
                grazing = (1 + self.reflectivity) / 2
                self._fold(grazing if self.coating else self.reflectivity)

        def _fold(self, strongest: float) -> None:
            """Line and defects in Fourier space: the mean of exp(2 pi i n order), n = 0, 1, ..."""
            number = np.arange(1 + int(np.ceil(np.log(NEGLECTED) / np.log(strongest))))
            mean = self.line.characteristic(number / self.free_spectral_range)
            rms, bow = (v * self.m_defect_order for v in (self.surface_rms, self.bow))
            mean = mean * np.exp(-2 * (np.pi * number * rms) ** 2) * np.sinc(number * bow)
            last = np.flatnonzero(np.abs(mean) * strongest**number > NEGLECTED)[-1]
            self.m_harmonics = [mi.Float(mean.real), mi.Float(mean.imag)]
            self.m_last = dr.opaque(mi.Int32, int(last))

        # --- mirrors

        def _mirror_on_axis(self, frequency: float) -> tuple[complex, complex, complex]:
            """`amplitudes_of` at normal incidence and a frequency over the laser's, in float64."""
            layers = [(n, n * d * 2 * np.pi / self.wavelength * frequency) for n, d in self.coating]
            with np.errstate(all="ignore"):  # NaN of a thick metal is refused as opaque
                return amplitudes_of(layers, self.index, self.plate_index, np)

        def _mirrors(self, sine2: Float) -> list[Mirrors]:
            """Amplitudes of the transverse field for s and p, at an outer angle's sine squared.

            One entry where both are the same.
            """
            if not self.coating:
                amplitude = dr.sqrt(self.m_reflectivity)
                passed = (1 - self.m_reflectivity) * self.m_passed
                reflected = mi.Complex2f(amplitude, 0)
                return [(-reflected, mi.Complex2f(passed, 0), reflected)]
            amplitudes = []
            for polarisation in "sp":
                layers = []
                for n, thickness in self.coating:
                    index = mi.Complex2f(n.real, n.imag)
                    cosine = dr.sqrt(1 - sine2 / (index * index))
                    phase = cosine * index * (2 * np.pi * thickness / self.wavelength)
                    layers.append((admittance(index, cosine, polarisation), phase))
                gap, plate = (
                    admittance(index, dr.sqrt(1 - sine2 / index**2), polarisation)
                    for index in (self.index, self.plate_index)
                )
                inside, passed, outside = amplitudes_of(layers, gap, plate, dr)
                amplitudes.append((inside, passed * self.m_passed, outside))
            return amplitudes

        # --- light

        def order_of(self, sine2: Float, offset: Float) -> Float:
            """Fractional phase order at an outer angle's sine squared and an offset (Hz)."""
            sine2 = sine2 / self.index**2
            cosine = dr.sqrt(1 - sine2)
            # order (1 - cosine), without the difference of two large numbers
            return (
                self.m_fraction
                - self.m_order * (sine2 / (1 + cosine))
                + (offset * self.m_orders_per_hertz * cosine)
            )

        def matrices(
            self, sine2: Float, offset: Float, defects: Float, reflects: bool = True
        ) -> tuple[Elements, Elements | None]:
            """Mueller elements of transmitted and of reflected light.

            ``offset`` (Hz) is the ray's frequency less the laser line's if sampled, the line's
            shift if folded.
            """
            order = self.order_of(sine2, offset)
            if self.line_shape == "sampled":
                order += defects
            sine, cosine = dr.sincos(dr.two_pi * (order - dr.round(order)))
            phasor = mi.Complex2f(cosine, sine)
            waves = []
            for inside, passed, outside in self._mirrors(sine2):
                trip = inside * inside * phasor
                waves.append((inside, passed, outside, trip, self._resonance(trip)))
            through = self._products(waves, lambda wave: (0, wave[1]))
            if not reflects:
                return through, None
            # the wave reflected at the first mirror, and round trips that leave backwards
            back = self._products(waves, lambda wave: (wave[2], wave[1] / wave[0]), sign=-1)
            return through, back

        def _resonance(self, trip: Complex) -> Complex:
            """Mean of the sum of all round trips, 1 / (1 - trip)."""
            if self.line_shape == "sampled":
                return 1 / (1 - trip)
            return _power_series(self.m_harmonics, self.m_last, trip)

        def _products(
            self,
            waves: list[Wave],
            amplitudes: Callable[[Wave], tuple[Complex, Complex]],
            sign: int = 1,
        ) -> Elements:
            """Means of products of s and p amplitudes ``a + b w / (1 - trip)`` as Mueller elements.

            With w = 1 for transmitted, w = trip for reflected light (``a`` not 0). The product of
            two sums of round trips is a sum again: (S1 + S2* - 1) / (1 - trip1 trip2*).
            """

            def product(first: Wave, second: Wave) -> Complex:
                (a1, b1), (a2, b2) = amplitudes(first), amplitudes(second)
                trip1, trip2, sum1, sum2 = first[3], second[3], first[4], second[4]
                both = (sum1 + dr.conj(sum2) - 1) / (1 - trip1 * dr.conj(trip2))
                if sign > 0:
                    return b1 * dr.conj(b2) * both
                crossed = dr.conj(a2) * b1 * (sum1 - 1) + a1 * dr.conj(b2) * dr.conj(sum2 - 1)
                return a1 * dr.conj(a2) + crossed + b1 * dr.conj(b2) * trip1 * dr.conj(trip2) * both

            s, p = waves[0], waves[-1]
            ss = product(s, s).real
            if len(waves) == 1:
                return ss, mi.Float(0), sign * ss, mi.Float(0)
            pp, sp = product(p, p).real, sign * product(s, p)
            return (ss + pp) / 2, (ss - pp) / 2, sp.real, sp.imag

        # --- Mitsuba

        def sample(
            self, ctx: Context, si: Interaction, sample1: Float, sample2: Point, active: Mask = True
        ) -> tuple[Drawn, Spectrum]:
            reflects = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0)
            transmits = ctx.is_enabled(mi.BSDFFlags.Null, 1)
            bs = mi.BSDFSample3f()
            if not (reflects or transmits):
                return bs, mi.Spectrum(0)
            if self.line_shape == "folded":
                offset, defects = self.line.shift(), mi.Float(0)
            else:
                offset = si.time
                # the place on the plates: a paraboloid's depth is evenly distributed over a disc
                normal = dr.sqrt(2) * dr.erfinv(dr.clip(2 * sample2.y - 1, -0.9999999, 0.9999999))
                defects = self.m_bow * (sample2.x - 0.5) + self.m_rms * normal
            sine2 = dr.square(si.wi.x) + dr.square(si.wi.y)
            through, back = self.matrices(sine2, offset, defects, reflects)
            if back is not None and transmits:
                bs.pdf = back[0] / (back[0] + through[0])
                reflected = sample1 < bs.pdf
                bs.pdf = dr.select(reflected, bs.pdf, 1 - bs.pdf)
                elements = [dr.select(reflected, b, t) for b, t in zip(back, through, strict=True)]
            else:
                bs.pdf, reflected = mi.Float(1), mi.Bool(back is not None)
                elements = list(through if back is None else back)
            bs.wo = dr.select(reflected, mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z), -si.wi)
            bs.eta = mi.Float(1)
            bs.sampled_component = dr.select(reflected, mi.UInt32(0), mi.UInt32(1))
            bs.sampled_type = dr.select(
                reflected, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.Null)
            )
            elements = [e / bs.pdf for e in elements]
            return bs, self._as_spectrum(ctx, si.wi, bs.wo, elements) & active

        def _as_spectrum(
            self, ctx: Context, wi: Vector, wo: Vector, elements: Sequence[Float]
        ) -> Spectrum:
            if not mi.is_polarized:
                return mi.Spectrum(elements[0])
            arriving, leaving = (-wo, wi) if ctx.mode == mi.TransportMode.Radiance else (-wi, wo)
            m00, m01, m22, m23 = elements
            matrix = mi.Spectrum(0)
            matrix[0, 0], matrix[0, 1] = m00, m01
            matrix[1, 0], matrix[1, 1] = m01, m00
            matrix[2, 2], matrix[2, 3] = m22, m23
            matrix[3, 2], matrix[3, 3] = -m23, m22
            normal = mi.Vector3f(0, 0, 1)

            def axis(direction: Vector) -> Vector:
                across = dr.cross(normal, direction)
                length = dr.norm(across)
                return dr.select(length > 0, across / length, mi.Vector3f(1, 0, 0))

            return mi.mueller.rotate_mueller_basis(
                matrix,
                arriving,
                axis(arriving),
                mi.mueller.stokes_basis(arriving),
                leaving,
                axis(leaving),
                mi.mueller.stokes_basis(leaving),
            )

        def eval(self, ctx: Context, si: Interaction, wo: Vector, active: Mask = True) -> Spectrum:
            return mi.Spectrum(0)

        def pdf(self, ctx: Context, si: Interaction, wo: Vector, active: Mask = True) -> Float:
            return mi.Float(0)

        def eval_pdf(
            self, ctx: Context, si: Interaction, wo: Vector, active: Mask = True
        ) -> tuple[Spectrum, Float]:
            return mi.Spectrum(0), mi.Float(0)

        def description(self) -> dict[str, float | str]:
            """Entries of an image's header; the order in two parts, exact in float32."""
            return {
                "gap": self.gap,
                "gap_index": self.index,
                "order_whole": int(np.floor(self.order_on_axis)),
                "order_fraction": float(self.order_on_axis % 1),
                "free_spectral_range": self.free_spectral_range,
                "reflectivity": self.reflectivity,
                "absorption": self.absorption,
                "surface_rms": self.surface_rms,
                "bow": self.bow,
                "line_shape": self.line_shape,
            }

        def traverse(self, callback: Traversal) -> None:
            if self.line is not None:
                callback.put("line", self.line, mi.ParamFlags.NonDifferentiable)
            for name, value in self.m_changeable.items():
                callback.put(name, value, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            now = {name: float(value[0]) for name, value in self.m_changeable.items()}
            tuned = now["order_fraction"] != self.order_fraction
            before = {name: getattr(self, name) for name in now}
            try:
                self._set(now, tuned)
            except ValueError:
                self._set(before, tuned=False)
                raise

        def _set(self, values: dict[str, float], tuned: bool) -> None:
            for name, value in values.items():
                setattr(self, name, value)
            self._prepare(tuned)
            # in place: parameters of a traversed scene refer to these arrays
            for name, array in self.m_changeable.items():
                array[:] = mi.Float64(getattr(self, name))

        def to_string(self) -> str:
            return (
                f"Etalon[order={self.order_on_axis:.6f}, gap={self.gap:.9g} m, "
                f"free_spectral_range={self.free_spectral_range:g} Hz, "
                f"reflectivity={self.reflectivity:g}, line_shape={self.line_shape}]"
            )

    return Etalon


@dr.syntax
def _power_series(harmonics: Sequence[Float], last: Int, z: Complex) -> Complex:
    """Sum of complex coefficients (real, imaginary arrays) times powers of z, by Horner's rule."""
    total, k = mi.Complex2f(0, 0), mi.Int32(last)
    while k >= 0:
        coefficient = mi.Complex2f(*(dr.gather(mi.Float, part, k) for part in harmonics))
        total = total * z + coefficient
        k -= 1
    return total


register(KIND, NAME, define)
