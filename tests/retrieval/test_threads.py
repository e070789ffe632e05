"""Threads of a retrieval. Detects a number that is not chosen, or not given back."""

import ast
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

import lidar_mi as lm
from benchmarks.cases import vortex_pair_images
from lidar_mi.retrieval.threads import SMALL, threads_for
from lidar_mi.retrieval.wind import methods


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_one_for_small_images_torch_s_own_for_large_ones():
    with threads_for(SMALL):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    with threads_for(SMALL + 1):
        assert torch.get_num_threads() == 2


def test_linear_algebra_of_numpy_and_scipy_likewise():
    # other packages load libraries of their own into this process
    program = "import numpy, scipy.linalg, threadpoolctl as t; print(t.threadpool_info())"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    used = {one["filepath"] for one in ast.literal_eval(answer.stdout.decode())}

    def numbers():
        return [
            one["num_threads"]
            for one in threadpool_info()
            if one["user_api"] == "blas" and one["filepath"] in used
        ]

    with threadpool_limits(2, user_api="blas"):
        before = numbers()
        with threads_for(SMALL):
            assert set(numbers()) == {1}
        assert numbers() == before
        with threads_for(SMALL + 1):
            assert numbers() == before


@pytest.mark.usefixtures("two_threads")
def test_the_number_is_given_back_after_an_error():
    with pytest.raises(ZeroDivisionError), threads_for(1):
        1 / 0  # noqa: B018
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("call", ["retrieve_wind", "fit_vortices"])
def test_retrievals_of_images_work_on_one(call, monkeypatch):
    pair = vortex_pair_images(0.0, 1, 40, 32)
    observed = []

    def watched(image1, *args, **options):
        observed.append(torch.get_num_threads())
        raise RuntimeError("seen")

    method = replace(methods.METHODS["variational"], find=watched)
    monkeypatch.setitem(methods.METHODS, "variational", method)
    monkeypatch.setattr("lidar_mi.retrieval.vortices.image_fit.fit_pixels", watched)
    with pytest.raises(RuntimeError, match="seen"):
        getattr(lm, call)(pair.first, pair.second, dt=0.1)
    assert observed == [1] and torch.get_num_threads() == 2
