"""The likelihood of a flow that integrates over the air, on air drawn from its model. Physics tier.

Detects: a wrong sign or factor of the score or of the information, a footprint that does not turn
and strain with the flow, blocks that miss pixels.
"""

import pytest
import torch

from lidar_mi.retrieval.flow.flow_spline import Axis, Mesh
from validation import marginal_likelihood as ml

SIZE = 12
SPECTRUM = torch.tensor([0.0, 0.01, 0.03, 0.02, 0.0], dtype=torch.double)
NOISE = 0.002


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return Mesh([Axis(SIZE, 5.0)] * 2, [torch.arange(SIZE).double()] * 2)


@pytest.fixture(scope="module")
def flow(mesh: Mesh) -> torch.Tensor:
    """Rotation by 0.2 and shear by 0.1 in dt about the middle."""
    z, y = torch.meshgrid(*[torch.arange(SIZE).double() - SIZE / 2] * 2, indexing="ij")
    return mesh.fitted(torch.stack([-0.2 * y + 0.1 * y, 0.2 * z]))


def counts(values: torch.Tensor | None = None) -> ml.Counts:
    one = torch.ones(SIZE, SIZE).double()
    images = (one, one) if values is None else list((1 + values).reshape(2, SIZE, SIZE))
    return ml.Counts(images, (NOISE * one, NOISE * one), 0.3)


def block_of(mesh: Mesh, flow: torch.Tensor, values: torch.Tensor | None = None) -> ml.Block:
    (block,) = ml.blocks(counts(values), mesh, flow)
    assert len(block.values) == 2 * SIZE**2
    # the amplitude is the smoothed image, and its noise is not that of the model
    return block._replace(amplitude=torch.ones(2 * SIZE**2).double())


def log_likelihood(block: ml.Block) -> float:
    """By the distribution of torch."""
    parts, _ = block.covariances()
    covariance = torch.einsum("m,mij->ij", SPECTRUM, parts) + torch.diag(block.noise) + 10.0
    zero = torch.zeros_like(block.values)
    law = torch.distributions.MultivariateNormal(zero, covariance)
    return float(law.log_prob(block.values))


def drawn(block: ml.Block, seed: int) -> torch.Tensor:
    parts, _ = block.covariances()
    covariance = torch.einsum("m,mij->ij", SPECTRUM, parts) + torch.diag(block.noise)
    white = torch.randn(
        len(covariance), dtype=torch.double, generator=torch.Generator().manual_seed(seed)
    )
    return torch.linalg.cholesky(covariance) @ white


def test_score_is_the_derivative_of_the_likelihood(mesh, flow):
    block = block_of(mesh, flow)
    block = block._replace(values=drawn(block, 1))
    score, _ = block.score_and_information(SPECTRUM)
    shift = torch.randn(
        block.places.shape, dtype=torch.double, generator=torch.Generator().manual_seed(2)
    )
    step = 1e-5
    two = [
        log_likelihood(block._replace(places=block.places + sign * step * shift))
        for sign in (1, -1)
    ]
    assert (two[0] - two[1]) / (2 * step) == pytest.approx(float((score.T * shift).sum()), rel=1e-5)


def test_scores_have_mean_zero_and_the_covariance_of_the_information(mesh, flow):
    """100 draws of air; places shifted together, and rotated: two directions."""
    block = block_of(mesh, flow)
    centre = block.places - block.places.mean(0)
    time = torch.tensor([1.0, -1.0]).double().repeat_interleave(SIZE**2)
    directions = torch.stack(
        [
            torch.stack([time, 0 * time]),
            torch.stack([-centre[:, 1] * time, centre[:, 0] * time]) / SIZE,
        ]
    )
    _, information = block.score_and_information(SPECTRUM)
    expected = torch.einsum("xca,cadb,xdb->x", directions, information, directions)
    scores = torch.stack(
        [
            torch.einsum(
                "xca,ca->x",
                directions,
                block._replace(values=drawn(block, seed)).score_and_information(SPECTRUM)[0],
            )
            for seed in range(100)
        ]
    )
    z = scores / expected.sqrt()
    assert (z.mean(0).abs() < 4 / 10).all()
    assert (z.square().mean(0) - 1).abs().max() < 4 * (2 / 100) ** 0.5


def test_footprints_turn_and_strain_with_the_flow(mesh, flow):
    """B at mid-time is G B G^T; G of half the motion is the matrix exponential."""
    block = block_of(mesh, flow)
    rates = torch.tensor([[0.0, -0.1], [0.2, 0.0]]).double()
    middle = SIZE * (SIZE // 2) + SIZE // 2
    for pixel, time in ((middle, 0.5), (SIZE**2 + middle, -0.5)):
        gradient = torch.matrix_exp(time * rates)
        expected = 0.3 * gradient @ gradient.T
        assert torch.allclose(block.footprint[pixel], expected, atol=1e-4)


def test_likeliest_spectrum_has_the_variance_of_the_air(mesh, flow):
    """Its sum is that of the air that was drawn, within four standard errors of 20 draws."""
    block = block_of(mesh, flow)
    parts, _ = block.covariances()
    sums = []
    for seed in range(20):
        one = block._replace(values=drawn(block, seed))
        sums.append(float(one.learnt(SPECTRUM.new_full((5,), 0.01), parts).sum()))
    sums = torch.tensor(sums)
    assert abs(float(sums.mean()) - float(SPECTRUM.sum())) < 4 * float(sums.std()) / 20**0.5
