"""The etalon's Mueller matrices against sums over round trips and another transfer-matrix code.

Detects: 0.01 m/s of phase lost in float32, 2e-5 in transmission or reflection, energy gained or
lost, a line or plate defects folded otherwise than averaged, s and p or the sign of their phase
exchanged, a Stokes axis turned, a lobe drawn with another probability than its weight says.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import tmm

pytestmark = pytest.mark.usefixtures("variant")

WAVELENGTH = 354.7e-9
LIGHT = 299_792_458.0
HERTZ_PER_SPEED = 2 / WAVELENGTH
ORDER = 77248.5
GAP = ORDER * WAVELENGTH / 2
# one fringe and the corners of a usual field; half a free spectral range to both sides
SINE = np.linspace(0, 0.016, 301)
OFFSET = np.linspace(-5.5e9, 5.5e9, 301)
# eight quarter-wave layers and an odd one, the plates' side first
COATING = [(1.48, 61e-9), (2.1, 42.2e-9), (1.48, 59.9e-9), (2.1, 50e-9)]


def etalon(**parameters):
    return mi.load_dict({"type": "etalon", "gap": GAP, "line_shape": "sampled", **parameters})


def coated(**parameters):
    text = ", ".join(f"{n} {d}" for n, d in COATING)
    return etalon(coating=text, plate_index=1.476, **parameters)


def elements(bsdf, sine, offset=0.0, defects=0.0):
    """Mueller elements (m00, m01, m22, m23) of transmitted and reflected light, float64."""
    sine, offset, defects = np.broadcast_arrays(sine, offset, defects)
    values = (mi.Float(np.float32(a).ravel()) for a in (np.square(sine), offset, defects))
    return [
        [np.broadcast_to(np.array(e, float), sine.size).reshape(sine.shape) for e in matrix]
        for matrix in bsdf.matrices(*values)
    ]


def phase(sine, offset=0.0, gap=GAP, index=1.0):
    """Phase of a round trip in extended precision, less whole turns."""
    sine, offset = np.longdouble(sine), np.longdouble(offset)
    frequency = np.longdouble(LIGHT) / np.longdouble(WAVELENGTH) + offset
    cosine = np.sqrt(1 - (sine / index) ** 2)
    order = (
        2 * np.longdouble(index) * np.longdouble(gap) * cosine * frequency / np.longdouble(LIGHT)
    )
    return 2 * np.pi * (order - np.round(order)).astype(float)


def round_trips(delta, reflectivity, absorption=0.0, number=200):
    """Transmittance and reflectance as sums of the waves of 0, 1, 2, ... round trips."""
    passed = 1 - reflectivity - absorption
    k = np.arange(number)[:, None]
    waves = reflectivity**k * np.exp(1j * k * delta)
    through = passed * waves.sum(0)
    root = np.sqrt(reflectivity)
    back = root - passed * root * np.exp(1j * delta) * waves.sum(0)
    return abs(through) ** 2, abs(back) ** 2


def as_float32(values):
    """What a float32 argument holds: the test is of the plugin's rounding, not the caller's."""
    return np.float32(values).astype(float)


@pytest.mark.parametrize("reflectivity", [0.3, 0.7, 0.9])
@pytest.mark.parametrize("absorption", [0.0, 0.02])
def test_is_the_sum_of_round_trips(reflectivity, absorption):
    bsdf = etalon(reflectivity=reflectivity, absorption=absorption)
    for sine, offset in ((SINE, 0.0), (0.003, OFFSET)):
        delta = phase(np.sqrt(as_float32(np.square(sine))), as_float32(offset))
        expected = round_trips(np.atleast_1d(delta), reflectivity, absorption)
        for matrix, value in zip(elements(bsdf, sine, offset), expected, strict=True):
            # 2e-6 orders times the steepest slope of the transmission
            np.testing.assert_allclose(matrix[0], value, atol=4e-6 / (1 - reflectivity) ** 2)
            assert (matrix[1] == 0).all() and (matrix[3] == 0).all()
        through, back = (matrix[0] for matrix in elements(bsdf, sine, offset))
        if absorption == 0:
            np.testing.assert_allclose(through + back, 1, atol=1e-5)
        else:
            assert (through + back < 1 - absorption).all()


def test_phase_costs_no_velocity_although_float32_does():
    """Order as velocity. Plain float32 is off by some m/s."""
    bsdf = etalon()
    sine2 = np.float32(SINE**2)
    offset = np.float32(2 * 50 / WAVELENGTH)
    exact = phase(np.sqrt(sine2.astype(float)), float(offset)) / (2 * np.pi)
    order = np.array(bsdf.order_of(mi.Float(sine2), mi.Float(float(offset))), float)
    speed = LIGHT / (2 * GAP) / HERTZ_PER_SPEED

    def error(found):
        return ((found - exact + 0.5) % 1 - 0.5) * speed

    assert np.abs(error(order)).max() < 0.01
    f = np.float32
    frequency = f(LIGHT / WAVELENGTH) + offset
    plain = f(2 * GAP) / f(LIGHT) * frequency * np.sqrt(1 - sine2)
    assert plain.dtype == np.float32
    assert np.std(error(plain.astype(float))) > 1


def test_gap_is_tuned_and_index_bends():
    bsdf = etalon(gap=13.7e-3, order_fraction=0.5)
    assert bsdf.gap == pytest.approx(GAP, abs=1e-15)
    reported = bsdf.description()
    assert (reported["order_whole"], reported["order_fraction"]) == (
        77248,
        pytest.approx(0.5, abs=1e-9),
    )
    assert bsdf.free_spectral_range == pytest.approx(LIGHT / (2 * GAP), rel=1e-12)
    glass = etalon(index=1.5, gap=10e-3)
    delta = phase(np.sqrt(as_float32(SINE**2)), 1e9, 10e-3, 1.5)
    expected, _ = round_trips(delta, 0.7)
    np.testing.assert_allclose(elements(glass, SINE, 1e9)[0][0], expected, atol=1e-4)


def stack(sine, offset, polarisation, gap=GAP):
    """The whole coated etalon between its plates, by Byrnes's transfer-matrix code."""
    layers = [*COATING, (1.0, gap), *COATING[::-1]]
    indices = [1.476, *(n for n, _ in layers), 1.476]
    thicknesses = [np.inf, *(d for _, d in layers), np.inf]
    angle = np.arcsin(sine / 1.476)
    wavelength = LIGHT / (LIGHT / WAVELENGTH + offset)
    return tmm.coh_tmm(polarisation, indices, thicknesses, angle, wavelength)


def test_coated_etalon_is_that_of_another_code():
    """Both polarisations with their phases, at the field's angles and at 30 degrees.

    Dispersion of the coatings beyond the delay of a reflection is left out: 1e-4 of transmission
    at half a free spectral range.
    """
    bsdf = coated()
    cases = [(s, 0.0) for s in SINE[::25]] + [(0.5, 0.0)] + [(0.003, o) for o in OFFSET[::25]]
    sine, offset = np.array(cases).T
    # 30 degrees are thousands of orders off the axis, more than float32 has digits for
    tolerance = np.where(sine > 0.1, 0.05, 3e-4)
    through, back = elements(bsdf, sine, offset)
    for k, (x, o) in enumerate(cases):
        x, o = np.sqrt(as_float32(x * x)), as_float32(o)
        s, p = (stack(x, o, which) for which in "sp")
        for matrix, intensity, amplitude in ((through, "T", "t"), (back, "R", "r")):
            m00, m01, m22, m23 = (element[k] for element in matrix)
            assert m00 == pytest.approx((s[intensity] + p[intensity]) / 2, abs=tolerance[k])
            assert m01 == pytest.approx((s[intensity] - p[intensity]) / 2, abs=tolerance[k])
            both = s[amplitude] * np.conj(p[amplitude])
            both *= np.sqrt(s[intensity] * p[intensity]) / abs(both)
            assert m22 + 1j * m23 == pytest.approx(both, abs=2 * tolerance[k])
    np.testing.assert_allclose(through[0] + back[0], 1, atol=1e-5)
    # at 30 degrees s and p are far apart, so that an exchange would show
    oblique = np.argmax(sine)
    assert abs(through[1][oblique]) > 0.02


def test_coating_that_absorbs():
    """An extinction coefficient, against the same code."""
    layers = [(n + 0.01j, d) for n, d in COATING]
    bsdf = etalon(coating=", ".join(f"{n.real} {d} {n.imag}" for n, d in layers), plate_index=1.476)
    indices = [1.476, *(n for n, _ in layers), 1.0, *(n for n, _ in layers[::-1]), 1.476]
    thicknesses = [np.inf, *(d for _, d in layers), GAP, *(d for _, d in layers[::-1]), np.inf]
    sine = SINE[::30]
    through, back = elements(bsdf, sine)
    for k, x in enumerate(np.sqrt(as_float32(sine**2))):
        found = [
            tmm.coh_tmm(which, indices, thicknesses, np.arcsin(x / 1.476), WAVELENGTH)
            for which in "sp"
        ]
        assert through[0][k] == pytest.approx(np.mean([f["T"] for f in found]), abs=5e-5)
        assert back[0][k] == pytest.approx(np.mean([f["R"] for f in found]), abs=5e-5)
    assert (through[0] + back[0] < 0.99).all()


LINE = {
    "type": "spectral_line",
    "weights": "0.2, 0.5, 0.3",
    "offsets": "0, -1.1e9, 1.6e9",
    "sigmas": "42e6, 0.9e9, 1.4e9",
    "v_los": 80.0,
}


@pytest.mark.parametrize("kind", ["reflectivity", "coating"])
def test_folded_is_the_mean_of_sampled(kind):
    """Quadrature over three Gaussians, Gaussian gaps and a bow, all at once."""
    make = etalon if kind == "reflectivity" else coated
    defects = {"surface_rms": 5e-9, "bow": 20e-9}
    folded = make(line_shape="folded", line=LINE, **defects)
    single = make()
    x, weight = np.polynomial.hermite_e.hermegauss(60)
    weight = weight / weight.sum()
    bow, fraction = np.polynomial.legendre.leggauss(12)
    sine = np.linspace(0, 0.012, 31)
    expected = np.zeros((2, 4, len(sine)))
    for w, o, s in ((0.2, 0, 42e6), (0.5, -1.1e9, 0.9e9), (0.3, 1.6e9, 1.4e9)):
        # line and rough plates are Gaussians of the order: one of their sum
        per_order = LIGHT / (2 * GAP)
        rms = 2 * 5e-9 / WAVELENGTH * per_order
        offset = o + np.hypot(s, rms) * x + 2 * 80 / WAVELENGTH
        for b, sb in zip(bow, fraction / 2, strict=True):
            order = 2 * 20e-9 / WAVELENGTH * b / 2
            found = elements(single, sine[:, None], offset, order)
            expected += w * sb * (np.array(found) @ weight)
    np.testing.assert_allclose(elements(folded, sine, 2 * 80 / WAVELENGTH), expected, atol=3e-5)


def transmitted(bsdf, sine, place):
    context = mi.BSDFContext()
    context.type_mask = +mi.BSDFFlags.Null
    si = interaction(np.tile([[sine], [0.0], [np.sqrt(1 - sine**2)]], place.shape[1]))
    _, weight = bsdf.sample(context, si, mi.Float(0.5), mi.Point2f(np.float32(place)), True)
    return np.array((weight[0, 0] if mi.is_polarized else weight)[0], float)


def interaction(wi, offset=0.0):
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(np.float32(wi))
    si.time = mi.Float(offset)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    return si


@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("component", [0, 1])
def test_mueller_matrix_turns_fields_as_their_s_and_p_parts(optics, mode, component):
    """Jones vectors in space: s and p parts take the amplitudes of the other code."""
    rng = np.random.default_rng(2)
    number, angle = 40, 0.5
    azimuth = rng.uniform(0, 2 * np.pi, number)
    side = rng.choice([-1, 1], number)  # from either side of the plates
    arriving = np.stack(
        [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle) * side], 1
    )
    leaving = arriving * (1 if component else (1, 1, -1))
    bsdf = coated(gap=3.2e-6)  # a few orders: float32 holds them at any angle
    context = mi.BSDFContext(getattr(mi.TransportMode, mode))
    context.component = component
    # light travels towards wi in one mode and away from it in the other
    wi = leaving if mode == "Radiance" else -arriving
    expected_wo = -arriving if mode == "Radiance" else leaving
    sampled, weight = bsdf.sample(context, interaction(wi.T), mi.Float(0.3), mi.Point2f(0.5), True)
    dr.eval(sampled, weight)  # at once, not element by element
    np.testing.assert_allclose(np.array(sampled.wo).T, expected_wo, atol=1e-6)
    matrix = np.array([[weight[r, c][0] for c in range(4)] for r in range(4)])
    matrix = np.moveaxis(np.broadcast_to(matrix, (4, 4, number)), 2, 0).astype(float)

    field = optics.jones(rng, arriving)
    s = np.cross([0, 0, 1], arriving)
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    into, out = np.cross(arriving, s), np.cross(leaving, s)
    # amplitudes from the intensities and the phase between s and p that the elements hold, which
    # another test compares with the other code: here it is their directions
    m00, m01, m22, m23 = elements(bsdf, np.sin(angle))[1 - component]
    amplitude_s = np.sqrt(m00 + m01)
    amplitude_p = (m22 - 1j * m23) / amplitude_s
    assert abs(m23) > 0.02  # so that a sign would show
    result = amplitude_s * (field * s).sum(1, keepdims=True) * s
    result = result + amplitude_p * (field * into).sum(1, keepdims=True) * out
    before = optics.stokes(field, *optics.axes(arriving))
    after = optics.stokes(result, *optics.axes(leaving))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", matrix, before), after, atol=2e-4)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_rgb"], indirect=True)
def test_both_lobes_together_conserve_energy():
    """Drawn with their shares: every weight is T + R, and the lobes' shares are T and R."""
    bsdf = etalon(absorption=0.03)
    number = 1 << 16
    si = interaction(np.tile([[0.003], [0.0], [np.sqrt(1 - 9e-6)]], number))
    sample = mi.Float((np.arange(number) + 0.5) / number)
    drawn, weight = bsdf.sample(mi.BSDFContext(), si, sample, mi.Point2f(0.5), True)
    (through, *_), (back, *_) = elements(bsdf, 0.003)
    np.testing.assert_allclose(np.array(weight[0]), through + back, rtol=1e-4)
    component = np.array(drawn.sampled_component)
    assert component.mean() == pytest.approx(through / (through + back), abs=2 / number)
    flags = np.array(drawn.sampled_type)
    assert set(flags[component == 1]) == {int(mi.BSDFFlags.Null)}
    wo = np.array(drawn.wo)
    assert (wo[2] > 0).sum() == (component == 0).sum()
    assert transmitted(bsdf, 0.003, np.full((2, 1), 0.5))[0] == pytest.approx(through, rel=1e-5)
    assert dr.all(bsdf.eval(mi.BSDFContext(), si, drawn.wo)[0] == 0)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"gap": 0.0}, "etalon.gap: 0.0 is not allowed; expected a finite number above 0"),
        ({"reflectivity": 1.0}, "etalon.reflectivity: 1.0 is not allowed"),
        ({"reflectivity": 0.0}, "etalon.reflectivity: 0.0 is not allowed"),
        ({"absorption": 0.3}, "etalon.absorption: 0.3 is not allowed; expected less than"),
        ({"absorption": -0.1}, "etalon.absorption"),
        ({"index": 0.9}, "etalon.index"),
        ({"order_fraction": 1.0}, "etalon.order_fraction"),
        ({"surface_rms": -1e-9}, "etalon.surface_rms"),
        ({"bow": float("nan")}, "etalon.bow"),
        ({"line_shape": "both"}, "one of folded, sampled"),
        ({"line_shape": "folded"}, "etalon.line: None is not allowed"),
        ({"coating": "2.1"}, "etalon.coating: '2.1' is not allowed; expected layers"),
        ({"coating": "2.1 x"}, "etalon.coating"),
        ({"coating": "0.5 1e-9"}, "etalon.coating"),
        ({"coating": "2.1 50e-9", "reflectivity": 0.5}, "either it or a coating"),
        ({"coating": "2 1e-4 3"}, "transmittance .* is not allowed"),
    ],
)
def test_wrong_parameters_are_named(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        etalon(**parameters)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"weights": "0, 0"}, "spectral_line.weights"),
        ({"weights": "1, -1", "offsets": "0, 0", "sigmas": "1, 1"}, "spectral_line.weights"),
        ({"sigmas": "-1"}, "spectral_line.sigmas"),
        ({"offsets": "0, 1"}, "spectral_line.offsets: .* expected as many as weights, 1"),
        ({"offsets": "a"}, "spectral_line.offsets: 'a' is not allowed; expected finite numbers"),
        ({"wavelength": -1.0}, "spectral_line.wavelength"),
        ({"v_los": float("inf")}, "spectral_line.v_los"),
    ],
)
def test_wrong_lines_are_named(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "spectral_line", **parameters})


@pytest.mark.parametrize(
    "changed",
    [
        {"gap": GAP + 3e-8},
        {"order_fraction": 0.25},
        {"reflectivity": 0.8, "absorption": 0.01},
        {"surface_rms": 3e-9, "bow": 5e-9},
    ],
)
def test_a_changed_etalon_is_a_new_one(changed):
    """Through ``mi.traverse``, folded with a line; the gap in double precision."""
    line = {"type": "spectral_line", "wavelength": WAVELENGTH}

    def folded(**values):
        return etalon(line_shape="folded", line=line, **values)

    bsdf, expected = folded(), folded(**changed)
    parameters = mi.traverse(bsdf)
    for name, value in changed.items():
        parameters[name] = value
    parameters.update()
    assert bsdf.gap == pytest.approx(expected.gap, rel=1e-15)
    assert float(parameters["gap"][0]) == bsdf.gap
    assert float(parameters["order_fraction"][0]) == pytest.approx(expected.order_on_axis % 1)
    before = elements(folded(), SINE)[0][0]
    for found, new in zip(elements(bsdf, SINE), elements(expected, SINE), strict=True):
        np.testing.assert_allclose(found, new, atol=1e-6)
    assert np.abs(elements(bsdf, SINE)[0][0] - before).max() > 1e-3


def test_a_change_that_is_refused_changes_nothing():
    bsdf = etalon()
    parameters = mi.traverse(bsdf)
    parameters["reflectivity"] = 1.5
    with pytest.raises(ValueError, match=r"etalon.reflectivity: 1.5 is not allowed"):
        parameters.update()
    assert bsdf.reflectivity == 0.7 and float(parameters["reflectivity"][0]) == 0.7
    assert "reflectivity" not in mi.traverse(coated())
