"""Rendered tensors with names, units and axes."""

from typing import Any

import numpy as np
import xarray as xr

from lidar_mi.arguments import checked_arguments
from lidar_mi.errors import InputError
from lidar_mi.io.exr import QUANTITIES, label_fringes, label_scan, unpack


@checked_arguments
def to_xarray(image: Any, scene: Any) -> xr.Dataset:
    """A rendered image of a `scanning_lidar` or a `ccd` with names, units and axes.

    Parameters
    ----------
    image : tensor, (height, width, channels)
        What ``mi.render(scene)`` returned; gradients are not kept.
    scene : mitsuba.Scene
        The scene, whose first sensor it was rendered by.

    Returns
    -------
    xr.Dataset
        Of a lidar on (gate, z, y), y and z ascending in m: ``S0`` ... ``S3``, ``S0_stderr`` and,
        with more than one order, each order's S0; ``Y`` (z, y), the attenuated backscatter of the
        first gate in m^-1 sr^-1, S0 r^2 / (A dr), the transmittance not corrected. Of a CCD on
        (y, x), pixels to the right and down.

    Raises
    ------
    InputError
        Another sensor, or an image of another size or number of channels.

    Examples
    --------
    >>> import lidar_mi as lm
    >>> scan = lm.to_xarray(mi.render(scene), scene)  # doctest: +SKIP
    >>> scan["Y"].plot()  # doctest: +SKIP
    """
    if not hasattr(scene, "sensors"):
        raise InputError(
            f"scene: {type(scene).__name__} is not allowed; expected a scene of mi.load_file"
        )
    sensor: Any = next(iter(scene.sensors()), None)
    integrator = scene.integrator()
    lidar, camera = hasattr(sensor, "beam_frame"), hasattr(sensor, "sample_towards_scene")
    if not (lidar or camera) or not hasattr(integrator, "quantities"):
        raise InputError(
            "scene: its first sensor is no 'scanning_lidar' (with the integrator 'gated_volpath') "
            "and no 'ccd' (with 'fringes'); expected one"
        )
    values, names = np.array(image), list(integrator.quantities())
    width, height = (int(n) for n in sensor.film().size())
    channels = len(names) * (sensor.gate_count if lidar else 1)
    if values.shape != (height, width, channels):
        raise InputError(
            f"image: shape {values.shape} is not allowed; expected {(height, width, channels)}, "
            "as mi.render returns it for this scene"
        )
    if lidar:
        return scan_dataset(values, names, sensor)
    layers = {name: values[..., k] for k, name in enumerate(names) if name in QUANTITIES}
    return label_fringes(layers, {"wavelength": scene.environment().line.wavelength})


def scan_dataset(image: np.ndarray, names: list[str], sensor: Any) -> xr.Dataset:
    """The rendered tensor with the beams' places in the middle of the gates as axes.

    A direction table need not form a grid; then pixel numbers serve as axes (``grid`` = 0).
    """
    rows, columns, _ = image.shape
    gates = sensor.gate_count
    start, stop = sensor.m_gate_start[0], sensor.m_gate_stop[0]
    beams, origins = (
        np.array(table, float).reshape(rows, columns, 3)[::-1, ::-1]
        for table in (sensor.m_directions, sensor.m_origins)
    )
    centre = (start + stop) / 2
    grid = bool((beams[..., 0] > 1e-6).all())
    if grid:
        along = (centre - origins[..., 0]) / beams[..., 0]
        y, z = (origins[..., axis] + along * beams[..., axis] for axis in (1, 2))
        grid = np.ptp(y, 0).max() < 1e-6 * centre and np.ptp(z, 1).max() < 1e-6 * centre
    if grid:
        y, z = y[0], z[:, 0]
    else:
        y, z = np.arange(columns, dtype=float), np.arange(rows, dtype=float)
    variables = unpack(image, names, gates)
    oblique = 1 / beams[..., 0] if sensor.gate_kind == "planar" else 1.0
    length = (stop - start) / gates * oblique
    middle = (start + (stop - start) / gates / 2 - origins[..., 0]) * oblique
    times = np.array(sensor.m_times, float).reshape(rows, columns)[::-1, ::-1]
    if times.any():
        variables["beam_time"] = ("z", "y"), times.astype(np.float32)
    area = np.pi * sensor.m_aperture[0] ** 2
    variables["Y"] = (("z", "y"), variables["S0"][1][0] * middle**2 / (area * length))
    fields = np.arctan(np.array(sensor.m_fov_tan, float)).tolist()
    attributes = {
        "grid": int(grid),
        "gate_kind": sensor.gate_kind,
        "gate_count": gates,
        "gate_start": start,
        "gate_stop": stop,
        "wavelength": sensor.laser.wavelength,
        "pulse_energy": sensor.laser.pulse_energy,
        "pulse_duration": sensor.laser.pulse_duration,
        "stokes_emitted": list(sensor.laser.stokes),
        "beam_radius": sensor.laser.m_radius[0],
        "divergence_full": 2 * sensor.laser.m_divergence_half[0],
        "aperture_radius": sensor.m_aperture[0],
        "fov_half": fields[0] if len(fields) == 1 else fields,
    }
    return label_scan(
        xr.Dataset(variables, coords={"gate": np.arange(gates), "y": y, "z": z}, attrs=attributes)
    )
