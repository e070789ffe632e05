"""The winds of successive slabs of air, each retrieved from the flow before."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import xarray as xr

from lidar_mi.retrieval.checks import checked_stack, on_device
from lidar_mi.retrieval.flow.next_flow import ExpectedFlow, Flow, expected_flow, next_flow
from lidar_mi.retrieval.flow.settings import VariationalSettings
from lidar_mi.retrieval.flow.variational import variational_and_flow
from lidar_mi.retrieval.images.displacement import Displacement
from lidar_mi.retrieval.images.windows import Windows
from lidar_mi.retrieval.threads import threads_for
from lidar_mi.retrieval.wind.methods import METHODS
from lidar_mi.retrieval.wind.pair import retrieve_wind


def expected_wind(
    image1: xr.DataArray,
    start: Flow,
    noise: float | xr.DataArray | None = None,
    device: str | torch.device = "cpu",
) -> ExpectedFlow:
    """A start for `wind_of_slab`: the flow expected, and the first image, before the second one.

    `noise` and `device` are those of `retrieve_wind`.
    """
    (image1,), level = checked_stack([image1], noise)
    sigma = on_device(level, device) if isinstance(level, xr.DataArray) else level
    with threads_for(image1.size):
        return expected_flow(start, on_device(image1, device), sigma)


def wind_of_slab(
    image1: xr.DataArray,
    image2: xr.DataArray,
    dt: float,
    start: Flow | ExpectedFlow | None = None,
    **options: Any,
) -> tuple[xr.Dataset, Flow | None]:
    """The wind by the method "variational", and the flow from which the next one may start.

    image1, image2 (z, y)
    dt: s.
    start: the flow expected, see `Flow.moved`, or what `expected_wind` made of it and of image 1:
        the retrieval starts there, with the prior and the noise learnt before, and from scratch
        only where the images do not fit to these. They are not searched again for structure at
        rest, changes of illumination and unrelated air.
    **options: of `retrieve_wind`.

    Returns
    -------
    wind : Dataset
        As from `retrieve_wind`; its attribute `from_start` is 1 if it was found from the start.
    flow : Flow or None
        None if the next wind has to be retrieved from scratch as well: large images, and those with
        structure at rest or a change of illumination, which is to be removed.
    """
    near, flow = None, None

    def find(
        first: torch.Tensor,
        second: torch.Tensor,
        template: int,
        search: int,
        stride: int,
        min_correlation: float,
        noise: float | torch.Tensor | None,
        more: Sequence[torch.Tensor],
        blur: float,
        settings: VariationalSettings | None,
    ) -> Displacement:
        nonlocal near, flow
        stack = [first, second, *more]
        windows = Windows(tuple(first.shape), template, search, stride)
        near = start and next_flow(start, stack, noise, min_correlation)
        displacement, flow = near or variational_and_flow(
            stack, windows, min_correlation, noise, blur, settings=settings, keep=True
        )
        return displacement

    chosen = replace(METHODS["variational"], find=find)
    wind = retrieve_wind(image1, image2, dt, chosen, checks=start is None, **options)
    if {"fixed_pattern", "illumination", "sampling"} & set(wind.attrs):
        flow = None
    return wind.assign_attrs(from_start=int(near is not None)), flow
