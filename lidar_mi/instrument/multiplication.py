"""Gain before the read-out: the register of an EMCCD, the channel plate of an image intensifier.

Both multiply every photoelectron by a random number g of mean G. A pixel of mean mu then has the
variance F^2 G^2 mu, with the excess noise factor F^2 = <g^2> / G^2.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def register_excess(gain: float, stages: int) -> float:
    """F^2 of a register in whose every stage an electron frees another one with probability p.

    F^2 = 1 + (1 - p) / (1 + p) (G - 1) / G, with G = (1 + p)^N, which is
    2 (G - 1) G^(-(N + 1) / N) + 1 / G (Robbins and Hadwen 2003, IEEE Trans. Electron Devices 50,
    1227): 1 without gain, 2 at a high one. G is the gain, N the number of stages.
    """
    p = gain ** (1 / stages) - 1
    return 1 + (1 - p) / (1 + p) * (gain - 1) / gain


def register_output(
    electrons: "torch.Tensor", gain: float, stages: int, generator: "torch.Generator"
) -> "torch.Tensor":
    """Electrons behind the register, float64, of whole numbers before it.

    All electrons remain; the number of freed ones is negative binomial. That is the exact law of
    very many stages (one electron becomes a geometric number), and has the exact mean and variance
    for any number of them.
    """
    import torch

    freed = gain - 1
    if freed == 0:
        return electrons.double()
    # variance of the electrons freed by one, beyond Poisson's, over the square of their mean
    extra = gain**2 * (register_excess(gain, stages) - 1) - freed
    shape = electrons * (freed**2 / extra)
    mean = _gamma(shape, generator) * (extra / freed)
    return electrons + torch.poisson(mean, generator=generator)


def intensified(
    electrons: "torch.Tensor", gain: float, excess: float, generator: "torch.Generator"
) -> "torch.Tensor":
    """Electrons on the chip behind an intensifier, float64, of so many from its photocathode.

    Pulse heights follow a Gamma distribution of mean ``gain`` and relative variance
    ``excess`` - 1; excess 2 is the exponential one of an unsaturated channel plate.
    """
    if excess == 1:
        return gain * electrons.double()
    return _gamma(electrons / (excess - 1), generator) * (gain * (excess - 1))


def _gamma(shape: "torch.Tensor", generator: "torch.Generator") -> "torch.Tensor":
    """Gamma numbers of scale 1; 0 where the shape is."""
    import torch

    # the sampler of torch.distributions.Gamma, which accepts no generator
    drawn = torch._standard_gamma(torch.where(shape > 0, shape, 1.0).double(), generator=generator)
    return torch.where(shape > 0, drawn, 0.0)
