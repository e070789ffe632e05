"""Variance components of the differences of warped images, on images whose components are known.

Detects noise that the flow absorbs and nobody counts, texture that is replaced and motion through
the plane of the wrong size, a tail of the prior that is not what splines leave.
`validation.flows` has the standard errors.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from lidar_mi.retrieval.flow import components, direct, variational
from lidar_mi.retrieval.flow.components import (
    _density_of_displaced,
    _flows_left,
    _mean_square_strain,
    _residual_operator,
    _shrunk,
    _unresolved_fraction,
    _variance_beyond,
    normal_fields,
)
from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from lidar_mi.retrieval.flow.likelihood import Linear
from lidar_mi.retrieval.flow.prior import first_prior
from lidar_mi.retrieval.flow.settings import VariationalSettings
from tests.support.flows import origin, plane_waves, texture
from tests.support.random_flows import random_flow

SETTINGS = VariationalSettings()
SHAPE = 96, 112
CONTRAST = 0.2


def noise(level, seed, shape=SHAPE):
    return level * np.random.default_rng([seed, 1]).standard_normal(shape)


def air(seed, shape=SHAPE, slope=4.0, longest=0.15):
    """Periodic texture whose spectral density falls as a power of the wavenumber."""
    z, y = 2 * np.pi * np.fft.fftfreq(shape[0])[:, None], 2 * np.pi * np.fft.rfftfreq(shape[1])
    gain = (longest**2 + z**2 + y**2) ** (-slope / 4)
    white = np.fft.rfft2(np.random.default_rng(seed).standard_normal(shape))
    field = np.fft.irfft2(gain * white, s=shape)
    return CONTRAST * field / field.std()


def advected(seed, flow, length=3.0):
    """Images of texture in a steady periodic flow (2, z, y), px in dt."""

    def wind(y, z):
        at = np.stack([z, y])
        w, v = (map_coordinates(part.numpy(), at, order=5, mode="grid-wrap") for part in flow)
        return v, w

    y, z = np.meshgrid(*(np.arange(float(n)) for n in reversed(flow.shape[1:])))
    waves = plane_waves(seed, length)
    return [texture(waves, *origin(wind, y, z, t, steps=3), CONTRAST) for t in (-0.5, 0.5)]


def retrieved(images, level, monkeypatch, stride=4):
    """Displacement, last model of the differences, and mean square residual of an image."""
    models, residuals = [], []

    def recorded(of_images, linear, *others):
        difference = (linear.warped[1] - linear.warped[0])[linear.valid]
        residuals.append(float(difference.square().mean()) / 2 / of_images.spline.passed)
        models.append(components.differences(of_images, linear, *others))
        return models[-1]

    with monkeypatch.context() as patch:
        patch.setattr(variational, "differences", recorded)
        found = variational.variational(
            *(torch.as_tensor(image) for image in images), noise=level, stride=stride
        )
    return found, models[-1], residuals[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "unbiased"), [(0.05, 0.025), pytest.param(0.01, 0.05, marks=pytest.mark.slow)]
)
def test_noise_that_the_flow_absorbs_is_counted(level, unbiased, monkeypatch):
    """Six flows of two spectra, noise not told: the mean of estimates over the sample variances.

    One scatters by 2 % in the larger noise, by 5 % in the smaller one, in which waves of 8 px that
    splines resolve in part make larger differences. Residuals of the larger one are 4 % too small.
    """
    found, residuals = [], []
    for turnover, rms in ((0.1, 0.6), (0.4, 0.3)):
        for seed in (1, 2, 3):
            flow, _ = random_flow(SHAPE, rms, turnover, SETTINGS.ratio, seed, shortest=8.0)
            of_images = [noise(level, 10 * seed + k) for k in (0, 1)]
            images = [a + b for a, b in zip(advected(seed, flow), of_images, strict=True)]
            _, model, residual = retrieved(images, None, monkeypatch)
            true = np.mean((of_images[1] - of_images[0]) ** 2) / 2
            found.append(model.amplitudes["noise"] / true)
            residuals.append(residual / true)
    assert np.mean(found) == pytest.approx(1, abs=unbiased)
    assert max(np.abs(np.log(found))) < 5 * unbiased
    assert np.mean(residuals) < 0.97 or level < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.002, 0.01])
@pytest.mark.parametrize("told", [True, False])
def test_replaced_texture_is_found(level, told, monkeypatch):
    """Texture of a spectrum k^-4 at rest; means of four seeds, of which one is right to 20 %."""
    for fraction in (0.0, 0.1, 0.3):
        found, noises = [], []
        for seed in range(1, 5):
            own, other = air(seed), air(100 + seed)
            of_images = [noise(level, 10 * seed + k) for k in (0, 1)]
            second = (1 - fraction) ** 0.5 * own + fraction**0.5 * other
            images = [own + of_images[0], second + of_images[1]]
            _, model, _ = retrieved(images, level if told else None, monkeypatch)
            found.append(model.amplitudes["replaced"])
            noises.append(model.amplitudes["noise"] / level**2)
        # of the texture that both images have
        common = (1 - fraction) ** 0.5
        assert np.mean(found) == pytest.approx(2 * (1 - common) / common, rel=0.2, abs=1e-3)
        if not fraction:
            assert max(found) < 0.01
            assert noises == pytest.approx([1.0] * 4, abs=0.08)


def slices(through, seed, level):
    """Two slices, displaced by `through` px, of an isotropic volume of spectral density K^-5.

    The waves of one wavenumber k in a slice then have the mean square wavenumber k^2 / 2 across it.
    """
    random = np.random.default_rng(seed)
    across = np.arange(-64, 64)[:, None, None] * 0.2
    z, y = 2 * np.pi * np.fft.fftfreq(128)[:, None], 2 * np.pi * np.fft.rfftfreq(160)
    square = across**2 + z**2 + y**2
    root = np.where(z**2 + y**2 > 0, np.maximum(square, 1e-3) ** -1.25, 0.0)
    wave = root * (random.standard_normal(root.shape) + 1j * random.standard_normal(root.shape))
    pair = [np.fft.irfft2((wave * np.exp(1j * across * d)).sum(0)) for d in (0.0, through)]
    return [image / pair[0].std() + level * random.standard_normal(image.shape) for image in pair]


@pytest.mark.slow
@pytest.mark.parametrize("through", [pytest.param(0.1, marks=pytest.mark.slow), 0.3])
def test_motion_through_the_plane_is_found(through, monkeypatch):
    """The mean of two pairs to 15 % of the displacement, without replaced texture."""
    amplitudes = [
        retrieved(slices(through, seed, 1e-3), 1e-3, monkeypatch)[1].amplitudes for seed in (1, 2)
    ]
    found = [one["through the plane"] ** 0.5 for one in amplitudes]
    assert np.mean(found) == pytest.approx(through, rel=0.2)
    assert max(one["replaced"] for one in amplitudes) < 0.01 * through**2


@pytest.mark.slow
@pytest.mark.parametrize("level", [1e-3, 0.02])
def test_noise_is_no_motion_through_the_plane(level, monkeypatch):
    """0.05 px at most: what changes long waves is seen through the flow."""
    for seed in (1, 2):
        _, model, _ = retrieved(slices(0.0, seed, level), level, monkeypatch)
        assert model.amplitudes["through the plane"] < 0.05**2


def test_density_of_a_gradient_across_the_plane():
    """T = exp(-(k^2 + q^2) / 2 s^2) has F = s^2 S; T = K^-5 has F = k^2 S / 2."""
    wave = (torch.arange(160).double() + 0.5) * np.pi / 160
    gaussian, power = torch.exp(-wave.square() / (2 * 0.4**2)), wave**-4
    found = _density_of_displaced(wave, gaussian)
    assert (found / gaussian)[:80].numpy() == pytest.approx(0.4**2, rel=0.01)
    # without the first shells, whose means are those of one wave, and the waves next to the last
    ratio = _density_of_displaced(wave, power) / (wave.square() * power / 2)
    assert ratio[8:50].numpy() == pytest.approx(1, abs=0.1)


def left_of(fields, axis):
    """What splines by least squares leave of fields (n, z, y), along both axes."""
    basis = axis.basis(torch.arange(axis.size).double()).numpy()
    held = basis @ np.linalg.pinv(basis)
    return fields - held @ fields @ held.T


@pytest.mark.parametrize("knots", [2.5, 4.0, 10.0])
def test_unresolved_fraction_of_waves(knots):
    """Of plane waves along one axis, of sixteen phases, fitted at the pixels away from the rim."""
    axis = Axis(240, knots)
    mesh = Mesh([axis] * 2, [torch.arange(240).double()] * 2)
    wave, fraction = _unresolved_fraction(mesh, torch.zeros(1).double())
    phases = np.arange(16) * np.pi / 16
    fields = np.cos(wave.numpy()[:, None, None] * np.arange(240.0) + phases[:, None])
    basis = axis.basis(torch.arange(240).double()).numpy()
    rest = fields - fields @ (basis @ np.linalg.pinv(basis)).T
    inside = rest[..., 40:-40]
    # waves shorter than two pixels do not exist; those of two or three have few phases on pixels
    long = wave.numpy() < 0.7 * np.pi
    expected = (inside**2).mean((1, 2)) / (fields[..., 40:-40] ** 2).mean((1, 2))
    assert fraction.numpy()[long] == pytest.approx(expected[long], abs=0.03)


@pytest.mark.parametrize("turnover", [0.1, 1.0])
def test_variance_beyond_the_splines(turnover):
    """Of random flows of the prior's own spectrum, from its strengths and by least squares.

    Waves at an angle to the knots are resolved better than those along them: 30 %.
    """
    size, knots = 192, 4.0
    axes = [Axis(size, knots)] * 2
    mesh = Mesh(axes, [torch.arange(size).double()] * 2)
    still = torch.zeros(2, *(axis.knots for axis in axes)).double()
    prior = first_prior(axes, still, 5.2, (1.0, 1.0), SETTINGS)
    fields, density = [], None
    for seed in range(4):
        flow, density = random_flow((size, size), 0.5, turnover, SETTINGS.ratio, seed, shortest=2.0)
        fields.append(flow.numpy())
    # vorticity of density 1 / (L + M k^2) with M = L / turnover^2
    unit = prior._replace(local=torch.ones_like(prior.local)).local
    ratio = torch.tensor([1.0, SETTINGS.ratio, turnover**-2, SETTINGS.ratio * turnover**-2])
    prior = prior._replace(local=unit * ratio[:, None, None])
    prior = prior._replace(local=prior.local * float(prior.density(1.0).mean()) / density(1.0))
    assert float(prior.density(0.3).mean()) == pytest.approx(density(0.3), rel=1e-6)
    left = left_of(np.concatenate(fields), axes[0])[:, 12:-12, 12:-12]
    found = _variance_beyond(prior, mesh)
    assert float(found.mean()) == pytest.approx(np.mean(left**2), rel=0.3)


def linear_case(level, seed=0, shape=(48, 56)):
    """Random slopes of texture, white noise, and a prior of known strength, in float64."""
    axes = [Axis(n, 4.0) for n in shape]
    mesh = Mesh(axes, [torch.arange(n).double() for n in shape])
    slope = torch.as_tensor(
        np.stack(np.gradient(air(seed, shape, slope=3.0) / CONTRAST)), dtype=torch.float64
    )
    weight = torch.full(shape, level**-2).double()
    images = torch.zeros(2, *shape).double()
    linear = Linear(
        slope, 0 * slope, weight, level**2, images, images, weight > 0, torch.ones_like(weight)
    )
    still = torch.zeros(2, *(axis.knots for axis in axes)).double()
    return (
        linear,
        mesh,
        still,
        first_prior(axes, still, 5.2, (1.0, 1.0), replace(SETTINGS, least_vorticity=0.1)),
    )


@pytest.mark.parametrize("level", [0.02, 0.1])
def test_residuals_have_the_variance_that_leverage_leaves(level):
    """Of r = R (e + J u): v - J C J^T at each pixel, in the mean to 3 standard errors of draws."""
    linear, mesh, still, prior = linear_case(level)
    posterior = direct.solved(linear, mesh, still, prior, SETTINGS, 0)
    absorb = _residual_operator(linear, mesh, posterior.response)
    covariance, _ = posterior.covariance(mesh.places)
    leverage = torch.einsum("azy,abzy,bzy->zy", linear.slope, covariance, linear.slope)
    expected = float((level**2 - leverage).mean())
    # the flow absorbs far more than the tolerance
    assert 0.8 * level**2 < expected < 0.95 * level**2
    white = absorb(level * normal_fields((24, *mesh.shape), linear.slope, 7))
    own = _flows_left(linear, mesh, prior, posterior.response)
    squares = [part.square().mean((1, 2)) for part in (white, own)]
    found = sum(float(part.mean()) for part in squares)
    error = sum(float(part.var()) / len(part) for part in squares) ** 0.5
    # as many squares as pixels: the mean's own scatter
    assert abs(found - expected) < 3 * error + 0.002 * level**2


def test_ratios_that_scatter_by_chance_are_those_of_one():
    """Of chi-square of 40 degrees, and of such about 0.5 and 2: errors below a fifth of chance."""
    random = np.random.default_rng(3)
    number = torch.full((2000,), 20.0).double()
    chance = torch.as_tensor(random.chisquare(40, 2000) / 40)
    use = torch.ones(2000, dtype=torch.bool)
    assert float((_shrunk(chance, number, use) - 1).square().mean()) < 0.05 * float(chance.var())
    level = torch.where(torch.arange(2000) % 2 == 0, 0.5, 2.0).double()
    found = _shrunk(level * chance, number, use)
    assert float(((found - level * chance) / level).square().mean()) < 0.2 * float(chance.var())
    use[:5] = False
    assert (_shrunk(level * chance, number, use)[:5] == 1).all()


def test_mean_square_strain():
    """The traceless strain of u_z = a z + b y, u_y = c z + d y along all directions; turning has
    none."""
    a, b, c, d = 0.2, 0.1, 0.3, -0.4
    one = torch.ones(3, 4)
    slopes = [torch.stack([a * one, c * one]), torch.stack([b * one, d * one])]
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    way = np.stack([np.cos(angle), np.sin(angle)])
    along = np.einsum("ik,ij,jk->k", way, [[a, b], [c, d]], way) - (a + d) / 2
    assert _mean_square_strain(slopes) == pytest.approx(np.mean(along**2))
    turning = [torch.stack([0 * one, c * one]), torch.stack([-c * one, 0 * one])]
    assert _mean_square_strain(turning) == 0
