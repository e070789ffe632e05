"""The quality of a displacement vector: flags, the texture of its window, its uncertainty."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from kornia.filters import spatial_gradient
from scipy.special import chdtri
from torch.nn.functional import max_pool2d, max_pool3d

from lidar_mi.errors import InputError
from lidar_mi.flags import Flag
from lidar_mi.retrieval.images.windows import Windows, working
from lidar_mi.retrieval.symmetric import eigenvalues, largest_eigenvalue


def check_between(name: str, value: float, low: float, high: float) -> None:
    """Raise an `InputError` unless a threshold lies between its limits."""
    if not low <= value <= high:
        raise InputError(f"{name}: {value!r} is not between {low} and {high}")


# A Sobel derivative, scaled to give the slope of a ramp, passes 3/16 of the variance of white
# noise: (1/2) from the difference times (1 + 4 + 1) / 16 from the smoothing across it.
_SOBEL_NOISE = 3 / 16
# Factor by which clear texture exceeds its thresholds.
_MARGIN = 1.5
# Standard error, px, up to which no vector is rejected.
SMALL = 0.05


class Texture(NamedTuple):
    """Texture of the templates, tensors of shape `windows.count`.

    slope: rms slope in the direction where it is weakest, relative to the local mean; px^-1.
    isotropy: that slope over the one in the strongest direction, 0 (parallel stripes) to 1.
    mean: mean of the template, in the image's unit.
    """

    slope: torch.Tensor
    isotropy: torch.Tensor
    mean: torch.Tensor


def texture(image: torch.Tensor, windows: Windows) -> Texture:
    """Texture of every template from its gradient matrix (structure tensor).

    The matrix is the mean over the template of the products of the gradients (Sobel's, by
    kornia, reaching one pixel beyond the template); its smaller eigenvalue lambda is the mean
    squared slope in the direction in which the image changes least. Two things follow:

    - With white noise of standard deviation s in both images, the variance of the displacement
      in that direction is at least 2 s^2 / (n^2 lambda) (Cramer-Rao). So sqrt(lambda) is compared
      with the noise; it is given as contrast relative to the local mean, per pixel.
    - Where the air in a window is also deformed, the strong direction causes errors in the weak
      one even without noise; they scale with the ratio of the eigenvalues, not their size. (CC 8
      in 16 on a simulated wake with 5 % of texture, no noise, rms of the vector's error: 0.9 m/s
      where the isotropy is above 0.5, 4 m/s below 0.13.) So the ratio of the slopes is given too.

    image (z, y): positive on the whole, as extinction and backscatter are: the contrast is
        relative.
    """
    image = working(image)
    gradient = spatial_gradient(image[None, None], mode="sobel")[0, 0]
    along_y, along_z = windows.of_templates(gradient.square())
    across = windows.of_templates(gradient[0] * gradient[1])
    squares = eigenvalues(along_y, across, along_z)
    weakest, strongest = (square.clamp(min=0).sqrt() for square in squares)
    mean = windows.of_templates(image)
    textured = weakest > 0
    return Texture(
        torch.where(textured, weakest / mean.abs(), 0.0),
        torch.where(textured, weakest / strongest, 0.0),
        mean,
    )


def low_texture(
    image: torch.Tensor,
    windows: Windows,
    min_texture: float,
    min_isotropy: float = 0.0,
    noise: float | torch.Tensor = 0.0,
) -> tuple[Texture, torch.Tensor]:
    """Texture of every template, and where it is too low for a displacement.

    Too low is: slope not above `min_texture`; isotropy below `min_isotropy`; or a squared slope
    below twice what the noise alone would give (3/16 of its variance after the Sobel filter),
    i.e. the image's own structure is weaker than the noise. At that limit an 8 x 8 template
    cannot do better than 0.4 px. The texture `min_texture` (px^-1) is relative to the local mean,
    the isotropy 0 to 1; the noise is the standard deviation of each pixel.

    Raises InputError: a threshold or the noise out of range, noise of another shape.
    """
    if not min_texture >= 0:
        raise InputError(f"min_texture: {min_texture!r} px^-1 is not >= 0")
    check_between("min_isotropy", min_isotropy, 0, 1)
    image = working(image)
    textures = texture(image, windows)
    sigma = torch.as_tensor(noise, dtype=image.dtype, device=image.device)
    if sigma.ndim and sigma.shape != image.shape:
        raise InputError(
            f"noise: shape {tuple(sigma.shape)} is neither one number nor the image's "
            f"{tuple(image.shape)}"
        )
    if not bool((sigma >= 0).all()):
        raise InputError("noise: not a standard deviation >= 0 everywhere")
    variance = windows.of_templates((sigma**2).expand_as(image))
    squared = (textures.slope * textures.mean) ** 2
    low = (
        (textures.slope <= min_texture)
        | (textures.isotropy < min_isotropy)
        | (squared < 2 * _SOBEL_NOISE * variance)
    )
    return textures, low


def clearly_textured(
    texture: Texture, min_texture: float, min_isotropy: float = 0.0
) -> torch.Tensor:
    """Where the texture passes thresholds half as high again, bool of shape `windows.count`.

    Slope and isotropy of a template are estimates from a few correlation lengths. Where the air's
    own are below the thresholds, some templates pass by chance, and most of these by little. Their
    errors are not those of templates whose texture is as good as it seems. An isotropy above 1/2
    counts half way to 1. The noise, which is known, needs no margin.
    """
    isotropy = min(_MARGIN * min_isotropy, (1 + min_isotropy) / 2)
    return (texture.slope > _MARGIN * min_texture) & (texture.isotropy >= isotropy)


def uncertain(covariance: torch.Tensor, limit: float = 0.5) -> torch.Tensor:
    """Where a displacement's standard error is beyond `limit` px in its worst direction.

    `covariance` (components, components, ...) in px^2; also where it is not known (NaN).
    """
    return worst_variance(covariance.nan_to_num(torch.inf, torch.inf)) > limit**2


def of_fit(covariance: torch.Tensor | None) -> torch.Tensor | int:
    """Flags of displacements whose standard errors by the method's own fit are too large."""
    if covariance is None:
        return 0
    return (Flag.LOW_TEXTURE * uncertain(covariance)).to(torch.int16)


def of_bootstrap(covariance: torch.Tensor) -> torch.Tensor:
    """Flags of displacements with standard errors from `bootstrap`: not known, or too large."""
    unknown = ~covariance.isfinite().all(0).all(0)
    poor = uncertain(covariance) & ~unknown
    return (Flag.LOW_TEXTURE * poor + Flag.ERROR_UNKNOWN * unknown).to(torch.int16)


def no_skill(d: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Where a displacement's variance is above a quarter of the variance of all about their mean.

    Variances are means over the components of d (components, ...) and covariance (components,
    components, ...). All have no skill where the median variance has none. Errors below 0.05 px
    always have skill, as in uniform wind every error exceeds the spread.
    """
    known = covariance.isfinite().all(0).all(0) & d.isfinite().all(0)
    if not bool(known.any()):
        return torch.zeros_like(known)
    variance = covariance.diagonal().mean(-1)
    spread = working(d)[:, known].var(1, correction=0).mean()
    limit = (spread / 4).clamp(min=SMALL**2)
    return known & ((variance > limit) | (variance[known].median() > limit))


def worst_variance(covariance: torch.Tensor) -> torch.Tensor:
    """Variance in the direction where it is largest, of matrices (components, components, ...)."""
    known = covariance.isfinite().all(0).all(0)
    matrices = torch.where(known, covariance, 0.0).movedim((0, 1), (-2, -1))
    return torch.where(known, largest_eigenvalue(matrices), torch.inf)


def misfit_variance(misfit: torch.Tensor, valid: torch.Tensor, number: int) -> torch.Tensor:
    """Variance of white noise from its sums of squares about the mean of `number` values each.

    The median of valid ones over that of chi-square with number - 1 degrees of freedom, robust
    against a few places where more than noise differs. Shape (); 0 without any sum.
    """
    median = torch.where(valid, misfit, torch.nan).nanmedian()
    return median.nan_to_num(0.0) / chdtri(number - 1, 0.5)


def non_finite(images: Sequence[torch.Tensor], windows: Windows) -> torch.Tensor:
    """Windows not finite in the search region of an image or the template of a volume."""
    bad = torch.stack([~torch.isfinite(image) for image in images]).any(0)
    return windows.of_regions(working(bad)) > 0


def nan_at(image: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """The image, as it is without such pixels, with NaN in their place."""
    if not bool(pixels.any()):
        return image
    image = image if image.is_floating_point() else working(image)
    return torch.where(pixels, torch.nan, image)


def usable(images: Sequence[torch.Tensor]) -> torch.Tensor:
    """Pixels (images, ...) that are three or more away from a non-finite one."""
    bad = torch.stack([~torch.isfinite(image) for image in images])
    if not bool(bad.any()):
        return ~bad
    pool = max_pool2d if bad.ndim == 3 else max_pool3d
    return pool(bad.float()[:, None], 7, stride=1, padding=3)[:, 0] == 0


def informative(images: Sequence[torch.Tensor]) -> torch.Tensor:
    """Pixels (images, ...) that filters hardly mix with non-finite ones.

    They are three pixels away from these, but only one from lines and single pixels of an image,
    across which smooth values (`inpainting.inpainted`) are good guesses.
    """
    bad = torch.stack([~torch.isfinite(image) for image in images])
    if bad.ndim > 3 or not bool(bad.any()):
        return usable(images)
    wide = torch.where(thick(bad), torch.nan, 0.0)
    return usable(list(wide)) & (max_pool2d(bad.float(), 3, stride=1, padding=1) == 0)


def thick(pixels: torch.Tensor) -> torch.Tensor:
    """Of pixels (..., z, y), those of areas wider than one: that squares of 2 x 2 px fit into."""
    square = pixels[..., :-1, :] & pixels[..., 1:, :]
    square = square[..., :-1] & square[..., 1:]
    wide = torch.zeros_like(pixels)
    rows, columns = square.shape[-2:]
    for i in (0, 1):
        for j in (0, 1):
            wide[..., i : i + rows, j : j + columns] |= square
    return wide


def filled(image: torch.Tensor) -> torch.Tensor:
    """The image with its mean in place of non-finite pixels, so that sums stay finite.

    Windows that hold such a pixel are flagged by `non_finite`; the others do not depend on it.
    """
    finite = torch.isfinite(image)
    if bool(finite.all()):
        return image
    return torch.where(finite, image, image[finite].mean() if bool(finite.any()) else 0.0)
