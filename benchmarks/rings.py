"""Wind from ring images: the annular fit, the 2-D fit, a fit with scipy and the paper's peak.

A call of the annular fit has the 63 frames of a slab, in memory. The first three fit the same model
with all parameters free, as for a camera whose rings' centre is roughly known. scipy's
``least_squares`` gets every pixel of one image, the analytic Jacobian and the weights at the
starting values, a straightforward fit of a single image. The paper's method takes the innermost
ring's peak from the circular average about the centre. Errors are those of the same images.
"""

import numpy as np
import torch
from scipy.optimize import least_squares

from lidar_mi.experiment.stages.ring_instrument import air_rings, pixel_noise
from lidar_mi.instrument.ccd import CCD
from lidar_mi.instrument.doppler import DopplerLidar
from lidar_mi.instrument.etalon import Etalon
from lidar_mi.instrument.fringe_camera import FringeCamera
from lidar_mi.retrieval.rings.bound import cramer_rao
from lidar_mi.retrieval.rings.likelihood_fit import fit_rings
from lidar_mi.retrieval.rings.mean_image import expected, mean_and_jacobian, pixel_waves
from lidar_mi.retrieval.rings.model import PARAMETERS, RingModel
from lidar_mi.retrieval.rings.peaks import find_centre, ring_radius

from .measure import in_turns
from .report import Comparison, row

PHOTONS, SPEED = 2.4e7, 20.0
ANNULAR, FLAT, SCIPY, PEAK = 63, 2, 1, 2  # images per call


def compare(repeats: int = 5, width: int = 960, height: int = 780) -> Comparison:
    """Images per second and errors of the wind."""
    camera = FringeCamera(width=width, height=height, pixel=7.4e-6 * 960 / width)
    model, noise = air_rings(DopplerLidar(), Etalon(), camera), pixel_noise(CCD())
    mean = expected(model, SPEED, PHOTONS).float()
    generator = torch.Generator().manual_seed(1)
    images = torch.poisson(mean.expand(ANNULAR, -1, -1), generator=generator)
    images += noise.read_noise * torch.randn(images.shape, generator=generator)
    found = in_turns(
        {
            "annular": lambda _: fit_rings(images, model, noise, centre=model.centre).v_los,
            "flat": lambda _: fit_rings(images[:FLAT], model, noise, method="pixels").v_los,
            "scipy": lambda _: scipy_fit(images[0], model, noise),
            "peak": lambda _: [
                ring_radius(image.numpy(), find_centre(image.numpy()), "ca", "r2")
                for image in images[:PEAK]
            ],
        },
        repeats,
    )
    speed = {
        side: [number / seconds for seconds, _ in found[side]]
        for side, number in (("annular", ANNULAR), ("flat", FLAT), ("scipy", SCIPY), ("peak", PEAK))
    }
    case = f"{width} x {height} px, centre free, all rings"
    bound = cramer_rao(model, PHOTONS, noise, v_los=SPEED)["v_los"]
    annular = found["annular"][0].result
    rms = float((annular - SPEED).square().mean().sqrt())
    away = {
        side: float((torch.as_tensor(found[side][0].result) - annular[:number]).abs().max())
        for side, number in (("flat", FLAT), ("scipy", SCIPY))
    }
    return Comparison(
        "Wind from images of an etalon's rings",
        "annular fit",
        "other",
        (
            row(
                case,
                "images per second",
                "",
                speed["annular"],
                speed["flat"],
                "higher",
                "other: 2-D fit",
            ),
            row(
                case,
                "images per second",
                "",
                speed["annular"],
                speed["scipy"],
                "higher",
                "other: scipy, one image at a time",
            ),
            row(
                case,
                "images per second",
                "",
                speed["annular"],
                speed["peak"],
                "higher",
                "other: the paper's circular average, one ring",
            ),
            row(
                case,
                "rms error of v_LOS",
                "m/s",
                [rms],
                [bound],
                "",
                f"{ANNULAR} images; other: Cramer-Rao bound",
            ),
            row(case, "largest difference of v_LOS to the 2-D fit", "m/s", [away["flat"]]),
            row(case, "largest difference of v_LOS to scipy's fit", "m/s", [away["scipy"]]),
        ),
        (
            (
                f"{PHOTONS:g} photons and {noise.read_noise:.2g} electrons of read noise per "
                "image; the 2-D fit starts from the annular one, scipy's from 5 m/s and 1 px off "
                "the truth."
            ),
        ),
    )


def scipy_fit(image: torch.Tensor, model: RingModel, noise) -> float:
    """v_LOS of one image, by scipy's Levenberg-Marquardt over all pixels."""
    blocks = list(pixel_waves(model))
    names = model.parameters
    places = [PARAMETERS.index(name) for name in names]
    values = image.double().flatten()
    level = float(values.mean())
    begin = {"v_los": SPEED + 5, "x": 1.0, "y": -1.0, "level": 0.9 * level}
    begin |= {"background": 0.1 * level, "temperature": model.middle_temperature}
    start = [begin.get(name, 0.0) for name in names]

    def evaluate(parameters):
        vector = model.start()
        vector[0, places] = torch.as_tensor(np.asarray(parameters))
        parts = [mean_and_jacobian(model, waves, vector, names) for waves in blocks]
        mean, jacobian = (torch.cat(both, -1)[0] for both in zip(*parts, strict=True))
        return mean, jacobian

    guess = evaluate(start)[0]
    sigma = noise.variance(guess, guess - begin["background"]).sqrt()
    found = least_squares(
        lambda p: ((evaluate(p)[0] - values) / sigma).numpy(),
        start,
        jac=lambda p: (evaluate(p)[1] / sigma).T.numpy(),
        x_scale="jac",
        method="lm",
    )
    return float(found.x[0])
