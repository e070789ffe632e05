"""The CCD behind the etalon: detection of photons, and its noise."""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from lidar_mi.errors import InputError
from lidar_mi.units import Frequency, Number, Time, Within, quantity


class CCD(BaseModel):
    """A CCD; numbers of photoelectrons unless stated otherwise.

    ``quantum_efficiency`` is 1 by default because the paper's photon numbers count the photons
    that the CCD detects. The other defaults are those of a scientific camera, not the paper's.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )

    quantum_efficiency: Annotated[
        Number, Within(1e-9, 1, "one photoelectron per photon at most")
    ] = Field(1.0, description="photoelectrons per photon")
    read_noise: Annotated[Number, Within(0, 1e6, "capacity of the largest pixels")] = Field(
        5.0, description="rms per pixel"
    )
    dark_current: Annotated[Frequency, Within(0, 1e12, "one electron per picosecond")] = Field(
        quantity("1 Hz"), description="photoelectrons per pixel in the dark"
    )
    integration_time: Annotated[Time, Within(0, 100000, "one day")] = Field(
        quantity("10 ms"), description="from one read-out to the next; a laser of 100 Hz"
    )
    full_well: Annotated[Number, Within(1, 1e12, "from a single photon to whole rows added")] = (
        Field(20e3, description="most a pixel holds; no blooming")
    )
    gain: Annotated[
        Number, Within(1e-6, 1e9, "from a fraction of an electron to the largest well")
    ] = Field(1.0, description="photoelectrons per step of the digitiser")
    bits: Annotated[int, Within(1, 32, "digitisers have 32 at most")] | None = Field(
        16, description="of the digitiser; null: no rounding"
    )
    bias: Annotated[int, Within(0, 2**31 - 1, "what 32 bits hold")] = Field(
        100, description="steps of the digitiser without a signal"
    )


def expose(
    expected: torch.Tensor,
    ccd: CCD,
    seed: int,
    images: int | Sequence[int] | None = None,
    modes: float | torch.Tensor = math.inf,
    background: float = 0.0,
) -> torch.Tensor:
    """Read the CCD: noisy images, in photoelectrons.

    The mean of a pixel is drawn from a Gamma distribution of shape ``modes`` (speckle), the number
    of photoelectrons from a Poisson one and clipped at the full well; Gaussian read noise is added,
    the sum rounded to the digitiser's steps and clipped to its range, and bias and gain are
    corrected. The means of background and dark current are not subtracted. Pixels are independent
    of each other: speckles are assumed to be smaller than a pixel.

    Parameters
    ----------
    expected : tensor (height, width) or (N, height, width)
        Mean photons of every pixel; noise is drawn on its device.
    seed : int
        Image k of a seed has its own stream of random numbers.
    images : int or sequence of int, optional
        Number of images, or the numbers k of the images; default: 1 or N.
    modes : float or tensor
        Degrees of freedom M of the speckle in a pixel, above 0; infinite: none.
    background : float
        Mean photons of incoherent light per pixel.

    Returns
    -------
    torch.Tensor
        float32, (number of images, height, width).

    Raises
    ------
    InputError
    """
    expected = torch.as_tensor(expected).double()
    _check_image(expected, background)
    modes = torch.as_tensor(modes, dtype=torch.float64, device=expected.device)
    if not bool((modes > 0).all()):
        raise InputError("modes: expected numbers above 0, or inf for no speckle")
    numbers = _image_numbers(images, expected)
    means = expected * ccd.quantum_efficiency
    floor = background * ccd.quantum_efficiency + ccd.dark_current * ccd.integration_time
    frames = expected.new_empty((len(numbers), *expected.shape[-2:]), dtype=torch.float32)
    # one image at a time, so that its noise depends only on its own number
    for i, (frame, number) in enumerate(zip(frames, numbers, strict=True)):
        mean = means if means.ndim == 2 else means[i]
        frame[:] = _read(mean, floor, modes, ccd, _generator(seed, number, expected.device))
    return frames


def _read(mean, floor, modes, ccd, generator):
    """One image in photoelectrons."""
    if not bool(torch.isinf(modes).all()):
        shape = modes.expand(mean.shape)
        # the sampler of torch.distributions.Gamma, which accepts no generator
        drawn = torch._standard_gamma(torch.nan_to_num(shape, posinf=1.0), generator=generator)
        mean = torch.where(torch.isinf(shape), mean, mean * drawn / shape)
    electrons = torch.poisson(mean + floor, generator=generator).clamp(max=ccd.full_well)
    if ccd.read_noise > 0:
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        electrons = electrons + ccd.read_noise * noise
    if ccd.bits is None:
        return electrons
    steps = torch.round(electrons / ccd.gain + ccd.bias).clamp(0, 2**ccd.bits - 1)
    return (steps - ccd.bias) * ccd.gain


def _generator(seed, number, device):
    """Streams of all pairs of seed and number are hashed apart."""
    for name, value in (("seed", seed), ("images", number)):
        if not isinstance(value, int | np.integer) or value < 0:
            raise InputError(f"{name}: {value!r} is not allowed; expected an integer, 0 or more")
    state = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0]
    # torch takes seeds as signed numbers
    return torch.Generator(device).manual_seed(int(state) >> 1)


def _image_numbers(images, expected):
    count = expected.shape[0] if expected.ndim == 3 else None
    if images is None:
        images = count or 1
    numbers = list(range(images)) if isinstance(images, int) else list(images)
    if count is not None and len(numbers) != count:
        raise InputError(
            f"images: {len(numbers)} are not allowed; expected one for each of {count}"
        )
    return numbers


def _check_image(expected, background):
    if expected.ndim not in (2, 3):
        raise InputError(
            f"expected: {expected.ndim} dimensions are not allowed; expected (height, width) or "
            "(N, height, width)"
        )
    if not bool((torch.isfinite(expected) & (expected >= 0)).all()):
        raise InputError("expected: negative or not finite photons are not allowed")
    if not (background >= 0 and math.isfinite(background)):
        raise InputError(
            f"background: {background:g} is not allowed; expected 0 photons per pixel or more"
        )
