"""Winds of a sequence of images, pair by pair, in a wind that changes from step to step.

Detects: pairs of wrong images, a wrong time or time step of a pair, vectors of one pair in the
place of another, a sequence that ends where one pair is bad, threads that disturb each other. Unit
tier.
"""

import threading

import numpy as np
import pytest
import torch
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.wind.options import VectorValidation, WindowSizes
from lidar_mi.retrieval.wind.pair import retrieve_wind
from lidar_mi.retrieval.wind.series import retrieve_winds
from tests.support.flows import axes, data_array, plane_waves, texture

WAYS = 0.0, 1.0, 0.5, 1.5
"""Of the air along y up to each image, m: 10, -10 and 5 m/s."""

STEPS = 0.1, 0.05, 0.2


@pytest.fixture(scope="module")
def images():
    waves = plane_waves(1, 3.0, 0.5)
    y, z = axes(48, 40)
    return [data_array(texture(waves, y - way, z[:, None]), y, z) for way in WAYS]


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def mean(winds, name="v"):
    return winds[name].where(winds["flag"] == 0).mean(("z", "y")).values


@pytest.mark.slow
def test_each_pair_has_its_wind_and_time(images):
    said = []
    winds = retrieve_winds(
        images, STEPS, windows=WindowSizes(stride=4), notice=lambda *call: said.append(call)
    )
    np.testing.assert_allclose(mean(winds), (10, -10, 5), atol=0.1)  # 0.01 px in 0.05 s
    np.testing.assert_allclose(winds["time"], [0.05, 0.125, 0.25])
    np.testing.assert_allclose(winds["dt"], STEPS)
    # float32: a photograph's vectors belong to the middle of its pair
    np.testing.assert_allclose(winds["vector_time"].mean(("z", "y")), winds["time"], rtol=1e-6)
    assert [text for text, _ in said] == ["images 0-1", "images 1-2", "images 2-3"]
    assert [fraction for _, fraction in said] == [0, 1 / 3, 2 / 3]
    alone = retrieve_wind(images[1], images[2], STEPS[1], windows=WindowSizes(stride=4))
    for name in ("v", "w_stderr", "flag", "y_vector"):
        np.testing.assert_array_equal(winds[name][1], alone[name])


@pytest.mark.slow
def test_pairs_as_asked_for(images):
    winds = retrieve_winds(images, 0.1, [(0, 2), (1, 3)], windows=WindowSizes(stride=4))
    np.testing.assert_allclose(mean(winds), (2.5, 2.5), atol=0.05)
    np.testing.assert_allclose(winds["time"], [0.1, 0.2])
    np.testing.assert_array_equal(winds["second_image"], [2, 3])


def test_a_bad_image_costs_its_pairs_alone(images):
    dark = images[1] * np.nan
    winds = retrieve_winds([images[0], images[1], dark], 0.1, windows=WindowSizes(stride=4))
    assert mean(winds)[0] == pytest.approx(10, abs=0.05)
    assert winds["remark"].values.tolist() == [
        "",
        "image2: no pixel is finite; expected light somewhere",
    ]
    assert np.isnan(winds["v"][1]).all() and (winds["flag"][1] == Flag.NO_MATCH).all()
    np.testing.assert_array_equal(winds["y_vector"][1][0], winds["y"])


@pytest.mark.slow
def test_noise_is_that_of_the_earlier_image(images):
    levels = [0.01, 0.5, None, None]
    winds = retrieve_winds(
        images,
        0.1,
        noise=levels,
        windows=WindowSizes(stride=4),
        validation=VectorValidation(min_texture=0),
    )
    pair = retrieve_wind(
        images[1],
        images[2],
        0.1,
        noise=0.5,
        windows=WindowSizes(stride=4),
        validation=VectorValidation(min_texture=0),
    )
    np.testing.assert_array_equal(winds["flag"][1], pair["flag"])
    # a noise that is given counts, although the residuals say that 0.5 is too large
    of_pairs = winds["v_stderr"].median(("z", "y")) * winds["dt"]
    assert float(of_pairs[1]) > 3 * float(of_pairs[0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dt": (0.1, 0.1)}, "dt: 2 steps are not allowed with 4 images"),
        ({"dt": 0.0}, "dt: 0.0 s is not a number > 0"),
        ({"pairs": ((2, 1),)}, "pairs: 2-1 is not allowed"),
        ({"pairs": ()}, "pairs: none given"),
        ({"method": "none"}, "images 0-1: method: 'none'"),
        ({"noise": (0.1,)}, "noise: 1 are not allowed"),
        ({"beam_times": ()}, "beam_times: 0 are not allowed"),
        ({"more": ()}, "expected beam_times"),
    ],
)
def test_bad_arguments(images, change, words):
    with pytest.raises(InputError, match=words.replace("(", r"\(")):
        retrieve_winds(**({"images": images, "dt": 0.1} | change))


def test_one_image_is_too_few(images):
    with pytest.raises(InputError, match="images: 1 are not allowed"):
        retrieve_winds(images[:1], 0.1)


@pytest.mark.slow
def test_a_stack_of_pairs_has_the_winds_of_one_after_the_other(images, two_threads):
    """Bit for bit, by two threads, and with the images' noise as a stack."""
    stack = xr.concat(images, "pair")
    level = xr.full_like(stack, 0.01) * (1 + np.arange(4))[:, None, None]
    winds = retrieve_winds(stack, 0.1, [(0, 1), (2, 3)], noise=level, windows=WindowSizes(stride=4))
    for number, (first, second) in enumerate([(0, 1), (2, 3)]):
        one = retrieve_wind(
            images[first], images[second], 0.1, windows=WindowSizes(stride=4), noise=level[first]
        )
        for name in ("v", "w", "v_stderr", "w_stderr", "flag"):
            np.testing.assert_array_equal(winds[name].values[number], one[name].values)


@pytest.mark.slow
def test_pairs_are_retrieved_side_by_side(images, two_threads, monkeypatch):
    """Each of two waits for the other: one after the other they would wait for ever."""
    both = threading.Barrier(2, timeout=60)

    def waiting(*args, **options):
        both.wait()
        return retrieve_wind(*args, **options)

    monkeypatch.setattr("lidar_mi.retrieval.wind.series.retrieve_wind", waiting)
    winds = retrieve_winds(images, STEPS, [(0, 1), (1, 2)], windows=WindowSizes(stride=4))
    assert winds.sizes["time"] == 2 and both.n_waiting == 0
    assert torch.get_num_threads() == 2


def test_a_stack_of_other_dimensions(images):
    with pytest.raises(InputError, match="images: dimensions z, y are not allowed"):
        retrieve_winds(images[0], 0.1)
    with pytest.raises(InputError, match="noise: dimensions z, y, pair are not allowed"):
        retrieve_winds(images, 0.1, noise=xr.concat(images, "pair").transpose("z", "y", "pair"))
