"""The CCD behind the etalon, with or without gain: detection of photons, and its noise."""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.instrument.multiplication import intensified, register_excess, register_output
from lidar_mi.units import Frequency, Number, Time, Within, quantity

if TYPE_CHECKING:
    import torch


class CCD(Description):
    """A CCD, an EMCCD or an intensified CCD; numbers of electrons unless stated otherwise.

    ``quantum_efficiency`` is 1 by default because the paper's photon numbers count the photons
    that the CCD detects. The other defaults are those of a scientific camera, not the paper's.

    A pixel of the image, ``camera.pixel`` wide, is read once. It consists of ``binning`` x
    ``binning`` pixels of the chip, to which dark current, full well and response refer.

    An ``emccd`` multiplies the electrons of a pixel in a register of ``stages`` on the chip
    (CCD97: 536). An ``iccd`` multiplies those of a photocathode in front of the chip, whose wells
    then hold the multiplied ones; ``intensifier_excess`` is F^2 = <g^2> / <g>^2 of its pulse
    heights g (F of 1.6 or more: Dussault and Hoess 2004, Proc. SPIE 5563, 195). Read noise and the
    digitiser's steps are numbers behind the gain.

    Hot and dead pixels are fractions of those of the image. Their places, as the responses, are the
    chip's, of ``response_seed``.

    ``nonlinearity`` a records q (1 - a q / q_full) of q electrons: positive where the response
    falls. q_full is ``register_well``, or without one what full wells of the chip become.
    """

    quantum_efficiency: Annotated[
        Number, Within(1e-9, 1, "one photoelectron per photon at most")
    ] = Field(1.0, description="photoelectrons per photon; 1, as the paper counts detected photons")
    read_noise: Annotated[Number, Within(0, 1e6, "capacity of the largest pixels")] = Field(
        5.0, description="rms per pixel of the image, electrons, behind a gain"
    )
    dark_current: Annotated[Frequency, Within(0, 1e12, "one electron per picosecond")] = Field(
        quantity("1 Hz"), description="photoelectrons per pixel in the dark"
    )
    integration_time: Annotated[Time, Within(0, 100000, "one day")] = Field(
        quantity("10 ms"), description="from one read-out to the next; a laser of 100 Hz"
    )
    full_well: Annotated[Number, Within(1, 1e12, "from a single photon to whole rows added")] = (
        Field(
            20e3,
            description="capacity of a pixel of the chip, electrons; the maxima of the rings must "
            "stay below",
        )
    )
    register_well: (
        Annotated[Number, Within(1, 1e12, "from a single photon to whole rows added")] | None
    ) = Field(
        None, description="most a cell of the output register holds, multiplied; null: no limit"
    )
    binning: Annotated[int, Within(1, 10000, "one pixel from a whole chip")] = Field(
        1,
        description="pixels of the chip along each side of a pixel of doppler.camera, which is "
        "read once",
    )
    multiplication: Literal["none", "emccd", "iccd"] = Field(
        "none",
        description="gain before the read-out: a register on the chip, or an image intensifier in "
        "front of it",
    )
    multiplication_gain: Annotated[
        Number, Within(1, 1e7, "from no gain to two channel plates in a row")
    ] = Field(1.0, description="mean electrons of one photoelectron")
    stages: Annotated[int, Within(16, 10000, "registers have 468 to 604")] = Field(
        536, description="of the register of an emccd"
    )
    intensifier_excess: Annotated[
        Number, Within(1, 100, "the noisiest channel plates have about 12")
    ] = Field(2.6, description="excess noise factor F^2 of an iccd")
    response_rms: Annotated[Number, Within(0, 0.3, "chips are uniform to a few per cent")] = Field(
        0.0, description="standard deviation of the pixels' responses over their mean"
    )
    response_seed: Annotated[int, Within(0, 2**31 - 1, "what 32 bits hold")] = Field(
        0, description="selects the chip: its responses are the same in every image"
    )
    hot_pixels: Annotated[Number, Within(0, 0.1, "no camera is sold with more")] = Field(
        0.0,
        description="fraction of the pixels that are hot; response_seed selects them, a "
        "calibration masks them",
    )
    hot_current: Annotated[Frequency, Within(0, 1e12, "as of the dark current")] = Field(
        quantity("500 kHz"), description="photoelectrons per hot pixel in the dark"
    )
    dead_pixels: Annotated[Number, Within(0, 0.1, "no camera is sold with more")] = Field(
        0.0, description="fraction of pixels that see no light"
    )
    nonlinearity: Annotated[Number, Within(-0.5, 0.5, "the response has to rise")] = Field(
        0.0, description="fraction of the electrons lost in the output at full well"
    )
    gain: Annotated[
        Number, Within(1e-6, 1e9, "from a fraction of an electron to the largest well")
    ] = Field(1.0, description="electrons per step of the digitiser")
    bits: Annotated[int, Within(1, 32, "digitisers have 32 at most")] | None = Field(
        16, description="of the digitiser; null: no rounding"
    )
    bias: Annotated[int, Within(0, 2**31 - 1, "what 32 bits hold")] = Field(
        100, description="steps of the digitiser without a signal"
    )

    @model_validator(mode="after")
    def _gain_has_its_kind(self) -> Self:
        if self.multiplication == "none" and self.multiplication_gain != 1:
            raise ValueError(
                f"multiplication_gain: {self.multiplication_gain:g} is not allowed with "
                "multiplication none; expected emccd or iccd"
            )
        return self

    @property
    def excess(self) -> float:
        """F^2, the variance of a multiplied photoelectron number over Poisson's."""
        if self.multiplication == "emccd":
            return register_excess(self.multiplication_gain, self.stages)
        return self.intensifier_excess if self.multiplication == "iccd" else 1.0

    @property
    def pixel_response_rms(self) -> float:
        """Rms response of the image's pixels, which are means over those of the chip."""
        return self.response_rms / self.binning

    @property
    def output_noise(self) -> float:
        """Rms noise that does not depend on the light, electrons behind the gain.

        Read noise and 1 / sqrt(12) of a step of the digitiser.
        """
        step = 0.0 if self.bits is None else self.gain
        return math.hypot(self.read_noise, step / math.sqrt(12))

    @property
    def chip_well(self) -> float:
        """Electrons that fill the chip's pixels of one pixel of the image."""
        return self.full_well * self.binning**2

    @property
    def output_well(self) -> float:
        """Most electrons of a pixel behind the gain."""
        if self.register_well is not None:
            return self.register_well
        return self.chip_well * (self.multiplication_gain if self.multiplication == "emccd" else 1)

    @property
    def saturation(self) -> float:
        """Photoelectrons of a pixel of the image at which a well or the digitiser is full.

        The chip's pixels are taken as evenly filled.
        """
        digits = math.inf if self.bits is None else (2**self.bits - 1 - self.bias) * self.gain
        behind = min(self.output_well, digits)
        if self.multiplication == "emccd":
            return min(self.chip_well, behind / self.multiplication_gain)
        return min(self.chip_well, behind) / self.multiplication_gain


def expose(
    expected: "torch.Tensor",
    ccd: CCD,
    seed: int,
    images: int | Sequence[int] | None = None,
    modes: "float | torch.Tensor" = math.inf,
    background: float = 0.0,
) -> "torch.Tensor":
    """Read the CCD: noisy images, in photoelectrons.

    The mean of a pixel is drawn from a Gamma distribution of shape ``modes`` (speckle) and
    multiplied by the pixel's response, the number of photoelectrons from a Poisson one. They are
    multiplied (`lidar_mi.instrument.multiplication`) and clipped at the wells, in the order of the
    camera; Gaussian read noise is added, the sum rounded to the digitiser's steps and clipped to
    its range, and bias and gains are corrected. The means of background and dark current are not
    subtracted, response and nonlinearity not corrected. Pixels are independent of each other:
    speckles are assumed to be smaller than a pixel.

    expected (tensor (height, width) or (N, height, width)): mean photons of every pixel; noise is
        drawn on its device.
    seed: image k of a seed has its own stream of random numbers.
    images: number of images, or the numbers k of the images; default: 1 or N.
    modes: degrees of freedom M of the speckle in a pixel, above 0; infinite: none.
    background: mean photons of incoherent light per pixel.

    Returns
    -------
    torch.Tensor
        float32, (number of images, height, width).
    """
    import torch

    expected = torch.as_tensor(expected).double()
    _check_image(expected, background)
    modes = torch.as_tensor(modes, dtype=torch.float64, device=expected.device)
    if not bool((modes > 0).all()):
        raise InputError("modes: expected numbers above 0, or inf for no speckle")
    numbers = _image_numbers(images, expected)
    means = expected * ccd.quantum_efficiency
    light: torch.Tensor | float = background * ccd.quantum_efficiency
    dark: torch.Tensor | float = ccd.dark_current * ccd.integration_time * ccd.binning**2
    if ccd.response_rms > 0:
        response = _response(ccd, expected)
        # of the response to light: dark electrons come on top
        means, light = means * response, light * response
    if ccd.hot_pixels or ccd.dead_pixels:
        hot, dead = _bad_pixels(ccd, expected)
        means, light = means * ~dead, light * ~dead
        dark = dark + ccd.hot_current * ccd.integration_time * hot
    floor = light + dark
    frames = expected.new_empty((len(numbers), *expected.shape[-2:]), dtype=torch.float32)
    # one image at a time, so that its noise depends only on its own number
    for i, (frame, number) in enumerate(zip(frames, numbers, strict=True)):
        mean = means if means.ndim == 2 else means[i]
        frame[:] = _read(mean, floor, modes, ccd, _generator(seed, number, expected.device))
    return frames


def _read(
    mean: "torch.Tensor",
    floor: "torch.Tensor | float",
    modes: "torch.Tensor",
    ccd: CCD,
    generator: "torch.Generator",
) -> "torch.Tensor":
    """One image in photoelectrons."""
    import torch

    if not bool(torch.isinf(modes).all()):
        shape = modes.expand(mean.shape)
        # the sampler of torch.distributions.Gamma, which accepts no generator
        # shape M over M: mean 1, variance 1 / M; without speckle any shape will do
        drawn = torch._standard_gamma(torch.nan_to_num(shape, posinf=1.0), generator=generator)
        mean = torch.where(torch.isinf(shape), mean, mean * drawn / shape)
    # sunlight and dark current have no speckle: they do not share the drawn mean
    electrons = _output(torch.poisson(mean + floor, generator=generator), ccd, generator)
    if ccd.read_noise > 0:
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=mean.device)
        electrons = electrons + ccd.read_noise * noise
    if ccd.bits is not None:
        steps = torch.round(electrons / ccd.gain + ccd.bias).clamp(0, 2**ccd.bits - 1)
        electrons = (steps - ccd.bias) * ccd.gain
    # photoelectrons, before the gain
    return electrons / ccd.multiplication_gain


def _output(
    photoelectrons: "torch.Tensor", ccd: CCD, generator: "torch.Generator"
) -> "torch.Tensor":
    """Electrons that reach the output: multiplied, clipped at the wells, of nonlinear response."""
    electrons, gain = photoelectrons, ccd.multiplication_gain
    # the photocathode is in front of the chip's wells, the register behind them
    if ccd.multiplication == "iccd":
        electrons = intensified(electrons, gain, ccd.intensifier_excess, generator)
    electrons = electrons.clamp(max=ccd.chip_well)
    if ccd.multiplication == "emccd":
        electrons = register_output(electrons, gain, ccd.stages, generator)
    if ccd.register_well is not None:
        electrons = electrons.clamp(max=ccd.register_well)
    if ccd.nonlinearity:
        electrons = electrons * (1 - ccd.nonlinearity * electrons / ccd.output_well)
    return electrons


def _response(ccd: CCD, expected: "torch.Tensor") -> "torch.Tensor":
    """Responses of the pixels, fixed for a chip."""
    import torch

    generator = torch.Generator().manual_seed(ccd.response_seed)
    drawn = torch.randn(expected.shape[-2:], generator=generator, dtype=torch.float64)
    return (1 + ccd.pixel_response_rms * drawn).clamp(min=0).to(expected.device)


def _bad_pixels(ccd: CCD, expected: "torch.Tensor") -> "tuple[torch.Tensor, torch.Tensor]":
    """Masks of the chip's hot and dead pixels; no pixel is both."""
    import torch

    height, width = expected.shape[-2:]
    order = np.random.default_rng([ccd.response_seed, 1]).permutation(height * width)
    # ranks of one order: with a larger fraction the same pixels stay hot
    rank = torch.from_numpy(np.argsort(order)).reshape(height, width).to(expected.device)
    hot, bad = (
        round(fraction * height * width)
        for fraction in (ccd.hot_pixels, ccd.hot_pixels + ccd.dead_pixels)
    )
    return rank < hot, (rank >= hot) & (rank < bad)


def _generator(seed: int, number: int, device: "torch.device") -> "torch.Generator":
    """The stream of a seed and a number, independent of those of all other pairs."""
    import torch

    for name, value in (("seed", seed), ("images", number)):
        if not isinstance(value, int | np.integer) or value < 0:
            raise InputError(f"{name}: {value!r} is not allowed; expected an integer, 0 or more")
    state = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0]
    # torch takes seeds as signed numbers
    return torch.Generator(device).manual_seed(int(state) >> 1)


def _image_numbers(images: int | Iterable[int] | None, expected: "torch.Tensor") -> list[int]:
    count = expected.shape[0] if expected.ndim == 3 else None
    if images is None:
        images = count or 1
    numbers = list(range(images)) if isinstance(images, int) else list(images)
    if count is not None and len(numbers) != count:
        raise InputError(
            f"images: {len(numbers)} are not allowed; expected one for each of {count}"
        )
    return numbers


def _check_image(expected: "torch.Tensor", background: float) -> None:
    import torch

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
