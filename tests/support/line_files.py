"""Files of lines of sight in the layouts of their makers, from one set of arrays.

Layouts: headers as in the instruments' files and in the documentation of halo-reader and xradar,
CfRadial 1.4 (NCAR/TN-504+STR), CfRadial 2.1, ARM's data object dlppi-b1.
"""

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import xarray as xr

HALO_HEAD = """\
Filename:\t{name}
System ID:\t{system}
Number of gates:\t{gates}
Range gate length (m):\t{length}
Gate length (pts):\t{points}
Pulses/ray:\t10000
No. of rays in file:\t{promised}
Scan type:\t{scan}
Focus range:\t65535
Start time:\t{start}
Resolution (m/s):\t0.0382
Range of measurement (center of gate) = (range gate + 0.5) * Gate length
Data line 1: Decimal time (hours)  Azimuth (degrees)  Elevation (degrees){tilt}
f9.6,1x,f6.2,1x,f6.2
Data line 2: Range Gate  Doppler (m/s)  Intensity (SNR + 1)  Beta (m-1 sr-1)
i3,1x,f6.4,1x,f8.6,1x,e12.6 - repeat for no. gates
****{width}
"""


@dataclass
class Lines:
    """Known lines: seconds after 2021-06-24 17:00 UTC, degrees, m, m/s, ratio."""

    seconds: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    range: np.ndarray
    velocity: np.ndarray
    snr: np.ndarray
    width: np.ndarray

    @property
    def time(self):
        start = np.datetime64("2021-06-24T17:00:00", "ns")
        return start + np.round(self.seconds * 1e9).astype("timedelta64[ns]")


WIND = (3.0, -5.0, 0.4)


def lines(count=6, gates=20, elevation=75.0, length=30.0, wind=WIND, step=2.0, noise=0.02):
    """A VAD of uniform wind: radial velocity = u sin(a) cos(e) + v cos(a) cos(e) + w sin(e)."""
    azimuth = np.arange(count) * 360.0 / count
    elevation = np.full(count, elevation)
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    radial = wind[0] * np.sin(a) * np.cos(e) + wind[1] * np.cos(a) * np.cos(e) + wind[2] * np.sin(e)
    ranges = length * (np.arange(gates) + 0.5)
    random = np.random.default_rng(11)
    velocity = radial[:, None] + noise * random.standard_normal((count, gates))
    snr = np.broadcast_to(0.5 * np.exp(-ranges / 2000), velocity.shape) + 0 * velocity
    width = np.full(velocity.shape, 1.5)
    seconds = step * np.arange(count, dtype=float)
    return Lines(seconds, azimuth, elevation, ranges, velocity, snr, width)


def halo_text(
    known,
    *,
    width=True,
    tilt=True,
    promised=None,
    scan="VAD",
    length=30.0,
    points=10,
    start="20210624 17:00:00.00",
    hours=None,
):
    """Text of a Halo Photonics file."""
    head = HALO_HEAD.format(
        name="VAD_194_20210624_170110.hpl",
        system=194,
        gates=known.range.size,
        length=length,
        points=points,
        promised=promised or len(known.seconds),
        scan=scan,
        start=start,
        tilt=" Pitch (degrees) Roll (degrees)" if tilt else "",
        width=" Instrument spectral width = 5.656623" if width else "",
    )
    hours = 17 + known.seconds / 3600 if hours is None else hours
    body = []
    for k, hour in enumerate(hours):
        ray = f"{hour:.8f} {known.azimuth[k]:6.2f} {known.elevation[k]:6.2f}"
        body.append(f"{ray} -0.11 -0.51" if tilt else ray)
        for gate in range(known.range.size):
            row = (
                f"{gate:3d} {known.velocity[k, gate]:.4f} {known.snr[k, gate] + 1:.6f}  1.344642E-5"
            )
            body.append(f"{row} {known.width[k, gate]:.4f} " if width else row)
    return (head + "\n".join(body) + "\n").replace("\n", "\r\n")


def write_arm(path: Path, known, *, missing=()):
    """ARM dlppi: NetCDF-3, intensity is SNR + 1, quality bits."""
    midnight = np.datetime64("2021-06-24T00:00:00", "ns")
    velocity = known.velocity.astype("f4").copy()
    quality = np.zeros(velocity.shape, "i4")
    for line, gate in missing:
        quality[line, gate] = 2
    degree = {"units": "degrees"}
    data = xr.Dataset(
        {
            "azimuth": ("time", known.azimuth.astype("f4"), degree),
            "elevation": ("time", known.elevation.astype("f4"), degree),
            "radial_velocity": (
                ("time", "range"),
                velocity,
                {"units": "m/s", "valid_min": np.float32(-20), "valid_max": np.float32(20)},
            ),
            "qc_radial_velocity": (("time", "range"), quality, {"units": "unitless"}),
            "intensity": (("time", "range"), (known.snr + 1).astype("f4"), {"units": "unitless"}),
            "attenuated_backscatter": (
                ("time", "range"),
                np.full(velocity.shape, 1e-6, "f4"),
                {"units": "1/(m sr)"},
            ),
            "lat": ((), np.float32(36.605), {"units": "degree_N"}),
            "lon": ((), np.float32(-97.487), {"units": "degree_E"}),
            "alt": ((), np.float32(317.0), {"units": "m"}),
        },
        {
            "time": (
                "time",
                (known.time - midnight).astype("int64") / 1e9,
                {"units": "seconds since 2021-06-24 00:00:00 0:00"},
            ),
            "range": ("range", known.range.astype("f4"), {"units": "m"}),
        },
        {
            "datastream": "sgpdlppiC1.b1",
            "range_gate_length": "30.000000 ",
            "samples_per_gate": "10",
            "scan_type": "Plan position indicator",
        },
    )
    data.to_netcdf(path, engine="scipy")


def write_windcube(path: Path, known, *, dbs=False, reference=True):
    """WindCube: root with the names of the sweeps, a group a sweep, CNR in dB.

    With ``dbs`` the ranges are those of every line, which has its own.
    """
    since = "2021-06-24T17:00:00Z"
    with h5py.File(path, "w") as file:
        file.attrs["title"] = "WindCube data"
        file.attrs["instrument_name"] = "WLS200s-218"
        file.attrs["Conventions"] = "CF/Radial 2.0 , CF-1.7"
        text = h5py.string_dtype()
        file.create_dataset("sweep_group_name", data=np.array(["Sweep_381"], object), dtype=text)
        file.create_dataset("sweep_fixed_angle", data=np.array([75.0], "f4"))
        for name, value in (("latitude", 47.1), ("longitude", 8.2), ("altitude", 500.0)):
            file.create_dataset(name, data=value)
        sweep = file.create_group("Sweep_381")
        gates = "gate_index" if dbs else "range"

        def put(name, values, dims, **attributes):
            made = sweep.create_dataset(name, data=values)
            for key, value in attributes.items():
                made.attrs[key] = value
            for k, dim in enumerate(dims):
                if dim != name:
                    made.dims[k].attach_scale(sweep[dim])
                else:
                    made.make_scale(name)
            return made

        units = "seconds since time_reference" if reference else f"seconds since {since}"
        put("time", known.seconds, ("time",), units=units)
        if dbs:
            put("gate_index", np.arange(known.range.size), ("gate_index",))
            ranges = np.tile(known.range, (len(known.seconds), 1))
            ranges[known.elevation > 89.9] *= np.sin(np.deg2rad(known.elevation.min()))
            put("range", ranges, ("time", gates), units="m")
        else:
            put("range", known.range, ("range",), units="m")
        put("azimuth", known.azimuth, ("time",), units="degrees")
        put("elevation", known.elevation, ("time",), units="degrees")
        both = "time", gates
        put("radial_wind_speed", known.velocity, both, units="m s-1")
        status = np.ones(known.velocity.shape, "i1")
        status[0, -1] = 0
        put("radial_wind_speed_status", status, both)
        put("cnr", 10 * np.log10(known.snr), both, units="dB")
        put("doppler_spectrum_width", known.width, both, units="m s-1")
        put("relative_beta", known.snr * 1e-6, both, units="m-1 sr-1")
        for name, value in (("sweep_mode", "dbs" if dbs else "ppi"), ("time_reference", since)):
            sweep.create_dataset(name, data=value, dtype=text)


def _cfradial(known, sign=1):
    toward = "toward" if sign < 0 else "away_from"
    standard = f"radial_velocity_of_scatterers_{toward}_instrument"
    return xr.Dataset(
        {
            "azimuth": ("time", known.azimuth, {"units": "degrees"}),
            "elevation": ("time", known.elevation, {"units": "degrees"}),
            "VR": (
                ("time", "range"),
                sign * known.velocity,
                {"units": "m/s", "standard_name": standard},
            ),
            "SNR": (("time", "range"), 10 * np.log10(known.snr), {"units": "dB"}),
            "WIDTH": (("time", "range"), known.width, {"units": "m/s"}),
        },
        {
            "time": ("time", known.seconds, {"units": "seconds since 2021-06-24T17:00:00Z"}),
            "range": ("range", known.range, {"units": "meters"}),
        },
    )


def write_cfradial1(path: Path, known, *, ragged=False, sign=1, sweeps=1):
    """CfRadial 1.4: all in the file, sweeps by their first and last rays."""
    data = _cfradial(known, sign)
    rays, gates = known.velocity.shape
    edges = np.linspace(0, rays, sweeps + 1).astype(int)
    data["sweep_start_ray_index"] = "sweep", edges[:-1].astype("i4")
    data["sweep_end_ray_index"] = "sweep", (edges[1:] - 1).astype("i4")
    for name, value in (("latitude", 47.1), ("longitude", 8.2), ("altitude", 500.0)):
        data[name] = (), value
    data.attrs = {"Conventions": "CF/Radial instrument_parameters", "version": "1.4"}
    if ragged:
        counts = np.full(rays, gates) - np.arange(rays) % 3
        keep = np.arange(gates) < counts[:, None]
        for name in ("VR", "SNR", "WIDTH"):
            values, about = data[name].values[keep], data[name].attrs
            data = data.drop_vars(name).assign({name: ("n_points", values, about)})
        data["ray_n_gates"] = "time", counts.astype("i4")
        data["ray_start_index"] = "time", (np.cumsum(counts) - counts).astype("i4")
    data.to_netcdf(path, engine="h5netcdf")


def write_cfradial2(path: Path, known, *, sweeps=2):
    """CfRadial 2.1: a group a sweep."""
    edges = np.linspace(0, len(known.seconds), sweeps + 1).astype(int)
    names = [f"sweep_{k}" for k in range(sweeps)]
    root = xr.Dataset(
        {
            "sweep_group_name": ("sweep", np.array(names, object)),
            "sweep_fixed_angle": ("sweep", np.full(sweeps, 75.0)),
            "latitude": ((), 47.1),
            "longitude": ((), 8.2),
            "altitude": ((), 500.0),
        },
        attrs={"Conventions": "Cf/Radial", "version": "2.0"},
    )
    root.to_netcdf(path, engine="h5netcdf")
    whole = _cfradial(known)
    for k, name in enumerate(names):
        part = whole.isel(time=slice(edges[k], edges[k + 1]))
        part.assign(sweep_mode=((), "azimuth_surveillance")).to_netcdf(
            path, engine="h5netcdf", mode="a", group=name
        )


def csv_text(known, *, km=False, sign=1):
    """A table: a row for each line and gate."""
    unit, scale = ("km", 1e-3) if km else ("m", 1.0)
    rows = [f"time,azimuth [deg],elevation [deg],range [{unit}],v_r [m/s],CNR [dB]"]
    for k, time in enumerate(known.time):
        for gate, distance in enumerate(known.range):
            rows.append(
                f"{time},{known.azimuth[k]},{known.elevation[k]},{distance * scale:.6f},"
                f"{sign * known.velocity[k, gate]:.6f},{10 * np.log10(known.snr[k, gate]):.6f}"
            )
    return "\n".join(rows) + "\n"
