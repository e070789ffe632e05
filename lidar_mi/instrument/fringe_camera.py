"""The camera behind the etalon: where the rings fall.

Pixels are counted from 0, x to the right and y down, from the middle of the top left one; images
have the shape (height, width).
"""

import math
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from lidar_mi.atmosphere.scattering.line import Line
from lidar_mi.description import Description
from lidar_mi.errors import InputError
from lidar_mi.instrument.etalon import Etalon, cosine_inside, fractional_order, harmonics, series
from lidar_mi.units import Angle, Length, Number, Within

if TYPE_CHECKING:
    import torch

# Two Gauss-Legendre points average a pixel to fourth order.
_NODES = {1: (0.0,), 2: (-0.5 / math.sqrt(3), 0.5 / math.sqrt(3))}


# Mean over a disc to fifth order (Abramowitz & Stegun 1972, 25.4.61): weight, x and y in radii.
_DISC = (
    (0.25, 0.0, 0.0),
    *(
        (0.125, math.sqrt(2 / 3) * math.cos(angle), math.sqrt(2 / 3) * math.sin(angle))
        for angle in (k * math.pi / 3 for k in range(6))
    ),
)
# Newton steps of the inverse distortion: below 1e-15 from a start that is 10 % off.
_STEPS = 6

_Place = Annotated[float, Within(-1e6, 1e6, "rings far beyond the CCD are straight")]
_Tilt = Annotated[Angle, Within(-0.5, 0.5, "rings farther from upright are ellipses of 1.1")]


class FringeCamera(Description):
    """Lens and the CCD's pixels; lengths in m, text with units is read as such.

    The paper gives 960 x 780 pixels; the other defaults are derived, as those of the
    `lidar_mi.instrument.etalon.Etalon`. Light at the angle theta to the axis falls
    f tan(theta) from ``centre`` in the ideal image. The light's fall-off towards the rim is a
    Gaussian about that centre; what a lens loses by itself, cos(theta)^4, is 0.05 % in the corners
    and neglected.

    A real lens distorts the ideal image, a real camera is tilted against it about ``centre``, and
    out of focus a point is a disc. The disc is the same everywhere: what a tilt adds, half a
    diagonal times tilt over the lens's f-number, is 2 um for 0.5 degrees at f/30.
    """

    focal_length: Annotated[
        Length, Within(0.001, 100, "from a telephone's camera to the longest telescope")
    ] = Field(0.3, description="of the lens")
    pixel: Annotated[
        Length, Within(1e-7, 0.01, "from a fraction of a wavelength to a photodiode")
    ] = Field(7.4e-6, description="side of a pixel")
    width: Annotated[int, Within(1, 20000, "the largest sensors have 2e8 pixels")] = Field(
        960, description="pixels of a row"
    )
    height: Annotated[int, Within(1, 20000, "the largest sensors have 2e8 pixels")] = Field(
        780, description="pixels of a column"
    )
    centre: tuple[_Place, _Place] | None = Field(
        None,
        description="(x, y) of the rings, pixels to the right and down from the top left one; "
        "default: the middle of the image",
    )
    illumination_radius: Annotated[
        Length, Within(1e-6, 1000, "from a pixel to wider than any CCD", or_infinite=True)
    ] = Field(
        math.inf,
        allow_inf_nan=True,
        description="1/e^2 radius of the light on the CCD; inf: even light",
    )
    tilt: tuple[_Tilt, _Tilt] = Field(
        (0.0, 0.0),
        description="of the CCD about its y and x axis: the sides of larger x, of larger y lie "
        "farther from the lens",
    )
    distortion: Annotated[Number, Within(-0.05, 0.05, "beyond that of a wide-angle lens")] = Field(
        0.0,
        description="k of r = r_ideal (1 + k (r_ideal / R)^2), R half the diagonal; above 0: "
        "pincushion",
    )
    defocus: Annotated[Length, Within(0, 0.01, "no rings are left")] = Field(
        0.0, description="diameter of the disc that a point of light is on the CCD"
    )

    @property
    def centre_pixel(self) -> tuple[float, float]:
        """(x, y) of the rings' centre in pixels."""
        return self.centre or ((self.width - 1) / 2, (self.height - 1) / 2)

    @property
    def half_diagonal(self) -> float:
        """Half of the CCD's diagonal, m."""
        return math.hypot(self.width, self.height) / 2 * self.pixel

    def radius_squared(self, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Squared distance of the pixels from the rings' centre, m^2, shape (height, width).

        In the ideal image; of the point ``shift`` (x, y; pixels) from the middle of each pixel.
        """
        return self.ideal_image(shift)[0]

    def ideal_image(
        self, shift: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[np.ndarray, np.ndarray | float]:
        """Where the pixels lie in the image of an ideal lens on an upright camera.

        Light through the middle of the lens meets the tilted CCD in P = (0, 0, f) + x e_x + y e_y,
        with e_x and e_y its axes, and the ideal image in f P / P_z. Areas grow by
        (e_x x e_y)_z (f / P_z)^3.

        shift: x, y; pixels from the middle of each pixel.

        Returns
        -------
        radius_squared : array (height, width)
            m^2.
        area : array (height, width), or 1
            Of the ideal image over that of the CCD.
        """
        column, row = self.centre_pixel
        x = (np.arange(self.width) + shift[0] - column) * self.pixel
        y = ((np.arange(self.height) + shift[1] - row) * self.pixel)[:, None]
        area: np.ndarray | float = 1.0
        if self.tilt != (0, 0):
            (cos_x, sin_x), (cos_y, sin_y) = ((math.cos(t), math.sin(t)) for t in self.tilt)
            # f / P_z
            nearer = 1 / (1 + (x * sin_x * cos_y + y * sin_y) / self.focal_length)
            area = cos_x * cos_y * nearer**3
            x, y = x * cos_x * nearer, (y * cos_y - x * sin_x * sin_y) * nearer
        squared = x**2 + y**2
        if self.distortion:
            size2, k = self.half_diagonal**2, self.distortion
            ideal = squared / size2
            for _ in range(_STEPS):
                # q (1 + k q)^2 is the squared radius of the distorted image
                slope = (1 + k * ideal) * (1 + 3 * k * ideal)
                ideal = ideal - (ideal * (1 + k * ideal) ** 2 - squared / size2) / slope
            squared, area = size2 * ideal, area / ((1 + k * ideal) * (1 + 3 * k * ideal))
        return squared, area

    def cosine(self, radius_squared: ArrayLike) -> np.ndarray:
        """Cosine of the angle to the axis, from squared distances on the CCD (m^2)."""
        return 1 / np.sqrt(1 + np.asarray(radius_squared, float) / self.focal_length**2)

    def illumination(self, radius_squared: ArrayLike) -> np.ndarray:
        """Light that reaches the CCD without an etalon, relative to the rings' centre."""
        return np.exp(-2 * np.asarray(radius_squared, float) / self.illumination_radius**2)


def fringe_image(
    camera: FringeCamera,
    etalon: Etalon,
    line: Line,
    v_los: ArrayLike = 0.0,
    photons: float = 2.4e7,
    counted: str = "detected",
    subsamples: int = 2,
) -> "torch.Tensor":
    """`fringe_values` as a tensor."""
    import torch

    return torch.from_numpy(
        fringe_values(camera, etalon, line, v_los, photons, counted, subsamples)
    )


def fringe_values(
    camera: FringeCamera,
    etalon: Etalon,
    line: Line,
    v_los: ArrayLike = 0.0,
    photons: float = 2.4e7,
    counted: str = "detected",
    subsamples: int = 2,
) -> np.ndarray:
    """Expected photons of every pixel, without noise or background.

    The width of the line is that at the centre of the rings: too large by 1 - cos(theta), 1e-4 in
    the corners. Its shift is exact.

    line: of air at rest; it is shifted here.
    v_los (N,): speed along the line of sight, m/s; positive when the air approaches.
    photons: photons of an image.
    counted {"detected", "before_etalon"}: place of the count: ``photons`` is the sum over the
        image, or the sum without an etalon, whose mean transmission is then the ratio of the image
        to it.
    subsamples {1, 2}: points per pixel in its average, along each axis. With 1 the rings are
        sampled in the middle of the pixels, which makes the contrast up to 0.3 % too large in the
        corners of the default camera.

    Returns
    -------
    np.ndarray
        float64, (height, width), or (N, height, width) for an array of speeds.
    """
    speeds = np.asarray(v_los, float)
    _check("v_los", speeds, abs(speeds) < 1e5, "finite speeds below 1e5 m/s")
    _check("photons", photons, photons >= 0, "0 or more")
    if counted not in ("detected", "before_etalon"):
        raise InputError(f"counted: {counted!r} is not allowed; expected detected or before_etalon")
    passed, light = _passed(camera, etalon, line, speeds.ravel(), subsamples)
    total = passed.sum((1, 2), keepdims=True) if counted == "detected" else light
    return (passed * (photons / total)).reshape(*speeds.shape, camera.height, camera.width)


def doppler_shift(v_los: ArrayLike, wavelength: float) -> np.ndarray:
    """Frequency shift 2 v_LOS / wavelength of backscattered light, Hz.

    v_los: speed along the line of sight, m/s; positive when the scatterer approaches.
    wavelength: m, in vacuum.
    """
    return 2 * np.asarray(v_los, float) / wavelength


def ring_radii(
    camera: FringeCamera, etalon: Etalon, wavelength: float, v_los: float = 0.0
) -> np.ndarray:
    """Radii of the fringes' peaks that fit into the half diagonal of the image, pixels, rising."""
    corner = math.hypot(camera.width, camera.height) / 2 * camera.pixel
    cosines = cosine_inside(etalon, camera.cosine(np.array([0, corner**2])))
    offset = doppler_shift(v_los, wavelength)
    first, last = fractional_order(etalon, wavelength, cosines, offset)
    orders = np.arange(math.floor(first), last, -1)
    # the order falls in proportion to the cosine in the gap
    per_cosine = (first - last) / (cosines[0] - cosines[1])
    cosine = 1 - (first - orders) / per_cosine
    sine2 = etalon.index**2 * (1 - cosine**2)
    return camera.focal_length * np.sqrt(sine2 / (1 - sine2)) / camera.pixel


def _passed(
    camera: FringeCamera, etalon: Etalon, line: Line, speeds: np.ndarray, subsamples: int
) -> tuple[np.ndarray, float]:
    """Light behind the etalon (N, height, width), and the total light in front of it."""
    if subsamples not in _NODES:
        raise InputError(f"subsamples: {subsamples!r} is not allowed; expected 1 or 2")
    nodes = _NODES[subsamples]
    amplitudes = harmonics(etalon, line.wavelength, line)
    passed = np.zeros((len(speeds), camera.height, camera.width))
    light = 0.0
    radius = camera.defocus / 2 / camera.pixel
    disc = [(w, radius * x, radius * y) for w, x, y in _DISC] if radius else [(1.0, 0.0, 0.0)]
    for weight, left, top in disc:
        for shift in ((left + x, top + y) for y in nodes for x in nodes):
            squared, area = camera.ideal_image(shift)
            cosine = cosine_inside(etalon, camera.cosine(squared))
            # a pixel has the light of its area in the ideal image
            falloff = weight * camera.illumination(squared) * area
            light += float(falloff.sum())
            for image, speed in zip(passed, speeds, strict=True):
                offset = doppler_shift(speed, line.wavelength)
                order = fractional_order(etalon, line.wavelength, cosine, offset)
                image += series(amplitudes, order) * falloff
    return passed, light


def _check(name: str, value: np.ndarray | float, good: np.ndarray | bool, allowed: str) -> None:
    values = np.atleast_1d(value)
    fine = np.atleast_1d(good) & np.isfinite(values)
    if not fine.all():
        raise InputError(f"{name}: {values[~fine][0]:g} is not allowed; expected {allowed}")
