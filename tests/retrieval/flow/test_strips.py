"""Large images solved in strips, against the same system solved at once.

Detects strips that miss a knot or count one twice, a rim that is not taken off, and overlaps that
are too narrow for the stated accuracy.
"""

from functools import partial

import numpy as np
import pytest
import torch

from lidar_mi.atmosphere.vortices.vortex import velocity, vortex_pair
from lidar_mi.retrieval.flow import direct, strips
from lidar_mi.retrieval.flow.settings import StripSettings, VariationalSettings
from lidar_mi.retrieval.flow.variational import variational
from tests.support.flows import axes, origin, plane_waves, texture

# of one step no more may be left than what is looked for
AT_ONCE = VariationalSettings(strips=StripSettings(largest=10**6, tolerance=1e-5))
IN_STRIPS = VariationalSettings(strips=StripSettings(largest=0))


@pytest.mark.parametrize("cells", [40, 69, 101, 249])
def test_cores_cover_all_cells_once(cells):
    cut = strips.strips(cells, core=10, overlap=6)
    assert [n for s in cut for n in range(s.core.start, s.core.stop)] == list(range(cells))
    assert len({s.cells.stop - s.cells.start for s in cut}) == 1
    for s in cut:
        assert s.cells.start == 0 or s.core.start - s.cells.start >= 6
        assert s.cells.stop == cells or s.cells.stop - s.core.stop >= 6


def changing_images(columns, rows, seed):
    """A vortex pair in texture that fades to a fifth along y, noise that doubles along z."""
    y, z = axes(columns, rows)
    grid, wind = np.meshgrid(y, z), partial(velocity, vortex_pair(400.0, 20.0, 3.0))
    waves = plane_waves(seed, 3.0, 0.5)
    pair = (texture(waves, *place) for place in (grid, origin(wind, *grid, 0.1)))
    fading = torch.linspace(1.0, 0.2, columns, dtype=torch.float64)
    level = torch.linspace(0.01, 0.02, rows, dtype=torch.float64)[:, None].expand(rows, columns)
    draw = torch.Generator().manual_seed(seed)
    kind = {"generator": draw, "dtype": torch.float64}
    images = [
        1 + fading * (torch.from_numpy(image) - 1) + level * torch.randn(rows, columns, **kind)
        for image in pair
    ]
    return images, level


@pytest.mark.slow
def test_few_steps_solve_a_system_where_texture_fades(monkeypatch):
    """The flow there follows from texture strips away: narrow overlaps take a hundred steps."""
    images, level = changing_images(columns=60, rows=560, seed=2)
    numbers, solve = [], strips.conjugate_gradients

    def counted(applied, *system):
        numbers.append(0)

        def once(flows):
            numbers[-1] += 1
            return applied(flows)

        return solve(once, *system)

    monkeypatch.setattr(strips, "conjugate_gradients", counted)
    variational(*images, noise=level, settings=IN_STRIPS)
    assert len(numbers) > 20 and 2 < max(numbers) < 40


@pytest.fixture(scope="module")
def systems():
    """The arguments of the steps at both levels of an image of 4 strips, and their posteriors."""
    images, level = changing_images(columns=64, rows=200, seed=3)
    steps, solved = [], direct.solved

    def kept(*step):
        steps.append((step, solved(*step)))
        return steps[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(direct, "solved", kept)
        variational(*images, noise=level, settings=AT_ONCE)
    return [steps[k] for k in (-5, -1)]


def test_standard_errors_are_within_five_per_cent(systems):
    step, whole = systems[-1]
    places = [torch.arange(3.5, axis.size - 4.0, dtype=torch.float64) for axis in step[1].axes]
    own, before = strips.solved(*step).covariance(places)
    exact, prior = whole.covariance(places)
    ratio = torch.stack([(own[a, a] / exact[a, a]).sqrt() for a in (0, 1)]).numpy()
    # variances of less information are larger, but for the iteration's rounding
    assert ratio.min() > 1 - 1e-6
    assert np.quantile(ratio, 0.999) < 1.05
    # of scales of the image: a threshold
    assert 0.5 < float(before.diagonal().mean() / prior.diagonal().mean()) < 1.1


def test_evidence_is_that_of_the_whole_system(systems):
    for step, whole in systems:
        (own, energy), (exact, same) = strips.solved(*step).evidence(), whole.evidence()
        torch.testing.assert_close(energy, same, rtol=1e-2, atol=1e-3 * float(same.mean()))
        weight = step[3].cell * step[3].local
        for kind in range(len(weight)):
            parts = [(weight * field)[kind] for field in (own, exact)]
            assert float(parts[0].sum() / parts[1].sum()) == pytest.approx(1, abs=0.05)
            assert float((parts[0] - parts[1]).abs().mean()) < 0.05 * float(parts[1].mean())


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="flows in strips differ by 0.061 standard errors, not 0.05")
def test_retrieval_is_that_of_the_whole_system():
    images, level = changing_images(columns=90, rows=240, seed=4)
    found, exact = (
        variational(*images, noise=level, settings=settings) for settings in (IN_STRIPS, AT_ONCE)
    )
    deviation = exact.covariance.diagonal().sqrt().movedim(-1, 0)
    assert float(((found.d - exact.d) / deviation).abs().max()) < 0.05
    ratio = (found.covariance.diagonal().sqrt().movedim(-1, 0) / deviation).numpy()
    assert np.quantile(np.abs(ratio - 1), 0.99) < 0.05
    assert int((found.flag != exact.flag).sum()) < 0.001 * found.flag.numel()
