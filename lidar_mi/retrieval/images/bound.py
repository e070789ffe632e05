"""The Cramer-Rao bound: smallest possible standard error of a displacement from an image pair."""

import torch

from lidar_mi.errors import InputError
from lidar_mi.retrieval.images.intensity import normalised, rms
from lidar_mi.retrieval.images.spline import band_limited
from lidar_mi.retrieval.images.windows import Windows, image_pair, working


def displacement_bound(
    image1: torch.Tensor,
    image2: torch.Tensor,
    noise: float | torch.Tensor | None = None,
    window: int = 8,
    stride: int = 1,
) -> torch.Tensor:
    """Least covariance of the displacement of every window, by any unbiased method.

    For one displacement of all pixels of a window and white Gaussian noise of standard deviation s
    in both images the Fisher information is sum(g g^T) / (2 s^2), g being the texture's slope, and
    its inverse the bound (Kay 1993, Fundamentals of Statistical Signal Processing, ch. 3). The
    slopes' products are means over both band-limited images, less the contribution of noise.
    A method can be better than the bound of a window only by using more than the window, as
    smooth flows do, and is worse where the flow is not uniform in it.

    image1, image2 (z, y): of the same texture.
    noise: standard deviation of each image's noise, of all pixels or of each (of image 1, if the
        images differ in brightness). Default: from the images' spectra.
    window, stride: pixels: size of the square windows, step from one to the next.

    Raises InputError: window, stride or noise out of range; images that differ in size or are not
    finite.

    Returns
    -------
    torch.Tensor, shape (3, rows, columns)
        Variances along z and y and their covariance, px^2; infinite where a window has no texture
        (a covariance of zero then). Windows lie wholly inside the image, centred on (window - 1) /
        2 + stride * (row, column).
    """
    image_pair(image1, image2)
    for image in (image1, image2):
        if not bool(torch.isfinite(image).all()):
            raise InputError(
                "image: non-finite pixels are not allowed; expected numbers throughout"
            )
    if min(image1.shape) < window:
        raise InputError(
            f"window: {window} px does not fit into the image of "
            f"{image1.shape[0]} x {image1.shape[1]} (z x y) px"
        )
    level = noise if noise is None else rms(noise)
    spline, level = band_limited(normalised([image1, image2]), level)
    places = [
        torch.arange(n, dtype=spline.coefficients.dtype, device=image1.device) for n in image1.shape
    ]
    z, y = torch.meshgrid(*places, indexing="ij")
    _, slope_z, slope_y = spline.sample(z.expand(2, -1, -1), y.expand(2, -1, -1))
    products = torch.stack([slope_z**2, slope_y**2, slope_z * slope_y]).mean(1)
    if isinstance(noise, torch.Tensor) and noise.ndim:
        if not bool((noise > 0).all()):
            raise InputError("noise: not a standard deviation > 0 everywhere")
        products *= level**2 / working(noise).square()
    # windows without a search region around them
    frame = Windows(tuple(n + 2 for n in image1.shape), window, window + 2, stride)
    zz, yy, zy = frame.of_templates(torch.nn.functional.pad(products, (1, 1, 1, 1)))
    determinant = zz * yy - zy**2
    sharp = determinant > 1e-12 * zz * yy
    inverse = torch.where(sharp, determinant, torch.nan)
    # `excess` is for the mean of two images: one has twice the noise in its slopes
    variance = 2 * level**2 * (2 * spline.excess - 1) / window**2
    bound = variance * torch.stack([yy / inverse, zz / inverse, -zy / inverse])
    return torch.where(sharp, bound, bound.new_tensor([torch.inf, torch.inf, 0.0])[:, None, None])
