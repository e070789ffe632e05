"""Scenes for the plugins' tests, and what the tests hold against them: numpy, no code of ours."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from validation import scenes
from validation.scenes import box, grid
from validation.scenes import medium as homogeneous

# --- scenes ---------------------------------------------------------------------------------


def lidar(size, gate, laser=None, environment=None, samples=64, **parameters):
    """A scanning lidar of (width, height) beams that records the gate (start, stop)."""
    sampler = {"type": "independent", "sample_count": samples}
    return scenes.lidar(size, gate, laser, environment, sampler=sampler, **parameters)


def scene(sensor, integrator=None, **shapes):
    """A scene; a medium used twice is the entry ``environment``, referred to by that id."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "gated_volpath", **(integrator or {})},
            # media first: others refer to them
            **{name: s for name, s in shapes.items() if name == "environment"},
            "sensor": sensor,
            **{name: s for name, s in shapes.items() if name != "environment"},
        }
    )


def render(loaded, **options):
    """A rendered scan as float64: Stokes (gates, 4, rows, columns), standard error of S0."""
    image = np.array(mi.render(loaded, **options)).astype(float)
    rows, columns, channels = image.shape
    image = image.reshape(rows, columns, channels // 5, 5).transpose(2, 3, 0, 1)
    return image[:, :4], image[:, 4]


ENVIRONMENT = {"type": "ref", "id": "environment"}


@pytest.fixture(scope="session")
def world():
    return SimpleNamespace(
        box=box,
        homogeneous=homogeneous,
        grid=grid,
        lidar=lidar,
        scene=scene,
        render=render,
        ENVIRONMENT=ENVIRONMENT,
    )


# --- statistics -----------------------------------------------------------------------------


def t_variance_bounds(number, photons, sigmas=4):
    """Within which the variance of ``number`` z-scores of means over ``photons`` must lie.

    For normal photons a z-score follows Student's t with n - 1 degrees of freedom, of variance
    (n - 1) / (n - 3). Photons of a bounded, flat or two-valued distribution deviate from that by
    a few 1 / n, which is added on both sides.
    """
    expected = (photons - 1) / (photons - 3)
    # fourth moment of t: 3 + 6 / (n - 5); variance of the sample variance
    spread = np.sqrt((2 + 6 / (photons - 5)) / number) * expected
    slack = 4 / photons
    return expected - sigmas * spread - slack, expected + sigmas * spread + slack


def assert_agree(values, errors, truth, photons, sigmas=4, bias=0.0, skewness=0.0):
    """Values with standard errors agree with the truth: mean and spread of their z-scores.

    ``bias`` is the relative truncation error allowed to the mean, on top of its statistics. Mean
    and standard error of skewed photons are correlated: the mean z-score is then about
    -skewness / (2 sqrt(n)).
    """
    values, errors, truth = np.broadcast_arrays(values, errors, truth)
    assert np.isfinite(values).all() and (errors > 0).all()
    z = ((values - truth) / errors).ravel()
    low, high = t_variance_bounds(z.size, photons, sigmas)
    allowed = sigmas * np.sqrt(high / z.size) + bias * np.mean(np.abs(truth) / errors)
    allowed += skewness / (2 * np.sqrt(photons))
    assert abs(z.mean()) < allowed, f"mean z-score {z.mean():.3g}, allowed {allowed:.3g}"
    assert low < z.var() < high, f"variance {z.var():.4g} outside {low:.4g} ... {high:.4g}"
    return z


@pytest.fixture(scope="session")
def statistics():
    return SimpleNamespace(t_variance_bounds=t_variance_bounds, assert_agree=assert_agree)


# --- polarisation ---------------------------------------------------------------------------


def unit_vectors(rng, number):
    vectors = rng.standard_normal((number, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def perpendicular(direction, rng):
    """Random unit vectors perpendicular to ``direction``."""
    return normalized(np.cross(direction, unit_vectors(rng, len(direction))))


def normalized(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def vector3(array):
    return mi.Vector3f(
        *(mi.Float(np.ascontiguousarray(c, np.float32)) for c in np.transpose(array))
    )


def interaction(incident):
    mei = mi.MediumInteraction3f()
    mei.wi = -vector3(incident)
    mei.sh_frame = mi.Frame3f(vector3(incident))
    if mi.is_spectral:
        mei.wavelengths = type(mei.wavelengths)(532.0)
    return mei


def evaluate(phase, incident, scattered):
    """Mueller matrices (n, 4, 4) about Mitsuba's own axes, and densities (n,)."""
    value, pdf = phase.eval_pdf(
        mi.PhaseFunctionContext(), interaction(incident), vector3(scattered)
    )
    matrix = [[np.array(value[row, column][0]) for column in range(4)] for row in range(4)]
    matrix = np.stack([np.stack(np.broadcast_arrays(*row)) for row in matrix])
    return matrix.transpose(2, 0, 1).astype(float), np.array(pdf).astype(float)


def axes(direction):
    """Mitsuba's reference axis of light along ``direction``, and the one that completes it.

    (first, second, direction) is right-handed.
    """
    first = np.array(mi.mueller.stokes_basis(vector3(direction))).T.astype(float)
    return first, np.cross(direction, first)


def stokes(field, first, second):
    """Stokes vectors (n, 4) of Jones vectors in space (n, 3) about two axes.

    V = -2 Im(E1 E2*) for fields ~ exp(-i omega t) (Bohren & Huffman 1983, section 2.11).
    """
    e1, e2 = (field * first).sum(-1), (field * second).sum(-1)
    cross = e1 * e2.conj()
    p1, p2 = np.abs(e1) ** 2, np.abs(e2) ** 2
    return np.stack([p1 + p2, p1 - p2, 2 * cross.real, -2 * cross.imag], -1)


def jones(rng, direction):
    """Random, fully polarised transverse fields of unit intensity, (n, 3) complex."""
    first = perpendicular(direction, rng)
    second = np.cross(direction, first)
    amplitude = rng.standard_normal((len(direction), 2)) + 1j * rng.standard_normal(
        (len(direction), 2)
    )
    amplitude /= np.linalg.norm(amplitude, axis=1, keepdims=True)
    return amplitude[:, :1] * first + amplitude[:, 1:] * second


@pytest.fixture(scope="session")
def optics():
    return SimpleNamespace(
        unit_vectors=unit_vectors,
        perpendicular=perpendicular,
        normalized=normalized,
        vector3=vector3,
        interaction=interaction,
        evaluate=evaluate,
        axes=axes,
        stokes=stokes,
        jones=jones,
    )
