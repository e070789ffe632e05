"""Standard errors of rings of plates that are uneven in patches; frames made without the program.

Detects: errors that leave out what the fit takes up of uneven plates (2 to 3 times too small in
patches of 40 and 80 px), even plates that are called uneven, a covariance that is none.
"""

import numpy as np
import pytest

from lidar_mi.retrieval.rings.analysis import analyse_rings
from lidar_mi.retrieval.rings.unevenness import Scores, uneven_covariance
from tests.support.ring_frames import Frame

SECTORS, RADII = 48, np.array([60.0, 110.0, 150.0, 180.0])


def scores(rng, field, noise=1.0, information=4.0):
    """A centre fitted to four rings: crests shift by (x, y) / 100, by the field, and by noise."""
    angle = (np.arange(SECTORS)[:, None] + 0.5) * 2 * np.pi / SECTORS
    x, y = RADII * np.cos(angle), RADII * np.sin(angle)
    rings = np.broadcast_to(np.eye(4), (SECTORS, 4, 4))
    columns = np.concatenate([np.stack([x, y], -1) / 100, rings], -1)
    matrix = information * columns.transpose(0, 2, 1) @ columns
    inverse = np.linalg.inv(matrix.sum(0))
    shift = field(rng, x, y) + noise * rng.standard_normal(x.shape) / np.sqrt(information)
    first = information * np.einsum("skp,sk->sp", columns, shift)
    fitted = inverse @ first.sum(0)
    score = first - matrix @ fitted
    return fitted, uneven_covariance(Scores(matrix, score, inverse, np.arange(2, 6), x, y))


def waves(rng, x, y):
    """Forty plane waves of random directions: a smooth field of standard deviation 3."""
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 40))
    k = rng.normal(1 / 35, 1 / 100, 40)
    along = k[:, None, None] * (np.cos(angle)[:, None, None] * x + np.sin(angle)[:, None, None] * y)
    return 3 * np.sqrt(2 / 40) * np.cos(along + phase[:, None, None]).sum(0)


def test_errors_by_a_field_are_covered():
    """40 fields of plane waves, smoother than the field that is assumed: stated too large by 2."""
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(40):
        fitted, covariance = scores(rng, waves)
        assert np.linalg.eigvalsh(covariance).min() > 0
        squares.append(fitted[:2] ** 2 / np.diag(covariance)[:2])
    assert 0.1 < np.mean(squares) < 1.5


def test_noise_alone_stays_what_it_is():
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(40):
        fitted, covariance = scores(rng, lambda rng, x, y: 0.0)
        squares.append(fitted[:2] ** 2 / np.diag(covariance)[:2])
    assert 0.4 < np.mean(squares) < 1.6


def test_even_and_uneven_plates_are_told_apart():
    even, uneven = (
        analyse_rings(Frame(plates=plates, patch=40.0).exposure(np.random.default_rng(1)))
        for plates in (0.0, 0.01)
    )
    assert not even.uneven and uneven.uneven
    assert uneven.spacing_std > 10 * even.spacing_std
    assert "uneven plates" in repr(uneven) and "uneven plates" not in repr(even)


@pytest.mark.slow
@pytest.mark.parametrize("plates", [0.003, 0.01])
@pytest.mark.parametrize("patch", [10.0, 20.0, 40.0, 80.0])
def test_errors_of_images_hold(plates, patch):
    """24 frames: rms errors of centre, spacing and fraction over those stated, 1.7 at most."""
    frame, squares = Frame(plates=plates, patch=patch), []
    for seed in range(24):
        found = analyse_rings(frame.exposure(np.random.default_rng([seed, 3])))
        off = [
            *np.subtract(found.centre, frame.centre) / found.centre_std,
            (found.spacing - frame.spacing) / found.spacing_std,
            (found.fraction[0] - frame.fraction[0]) / found.fraction_std[0],
        ]
        squares.append(np.square(off))
    rms = np.sqrt(np.mean(squares, 0))
    assert (rms < 1.7).all() and 0.3 < rms.mean() < 1.4, rms
