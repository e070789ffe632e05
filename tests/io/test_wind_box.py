"""Boxes of wind of TurbSim and HAWC2. Unit and physics tier.

Detects: planes, components or axes that are exchanged or turned, a scale or offset that is not
applied, time that runs the wrong way along x, a damaged file that is read.
"""

import struct

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.io.wind_box import read_bts, read_mann

STEPS, NY, NZ, TOWER = 5, 4, 3, 2
DY, DZ, DT, MEAN, BOTTOM = 6.0, 5.0, 0.5, 8.0, 20.0


def speeds():
    """u, v, w (m/s) on (time, y, z), each value another."""
    t, y, z = np.meshgrid(np.arange(STEPS), np.arange(NY), np.arange(NZ), indexing="ij")
    return 8 + 0.5 * t, 0.25 * y - 0.1 * t, -0.3 * z + 0.05 * y


def bts(kind=7):
    """A file by the description of the format: slopes and offsets from the range of each."""
    body, scales = np.zeros((STEPS, 3 * (NY * NZ + TOWER)), "<i2"), []
    for component, values in enumerate(speeds()):
        slope = 65535 / max(np.ptp(values), 1e-3)
        offset = -32768 - slope * values.min()
        scales += [slope, offset]
        for step in range(STEPS):
            for z in range(NZ):
                for y in range(NY):
                    number = round(slope * values[step, y, z] + offset)
                    body[step, component + 3 * (y + NY * z)] = number
    text = b"made by a test"
    head = struct.pack("<h4i", kind, NZ, NY, TOWER, STEPS)
    head += struct.pack("<6f", DZ, DY, DT, MEAN, 90.0, BOTTOM) + struct.pack("<6f", *scales)
    return head + struct.pack("<i", len(text)) + text + body.tobytes()


@pytest.mark.parametrize("kind", [7, 8])
def test_turbsim(tmp_path, kind):
    (tmp_path / "a.bts").write_bytes(bts(kind))
    found = read_bts(tmp_path / "a.bts")
    assert found["u"].dims == ("x", "y", "z")
    # the first grid has gone farthest with the wind
    np.testing.assert_allclose(found["x"], -MEAN * DT * np.arange(STEPS)[::-1])
    np.testing.assert_allclose(found["y"], [-9, -3, 3, 9])
    np.testing.assert_allclose(found["z"], BOTTOM + DZ * np.arange(NZ))
    for name, values in zip("uvw", speeds(), strict=True):
        np.testing.assert_allclose(found[name].values[::-1], values, atol=1e-4)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "0 bytes are no TurbSim field"),
        (b"\x89PNG" + bytes(200), "no header of a TurbSim field"),
        (bts()[:-2], "is cut short"),
        (bts()[:2] + struct.pack("<i", -3) + bts()[6:], "no header of a TurbSim field"),
        (bts()[:30] + struct.pack("<f", 0.0) + bts()[34:], "mean wind at the hub of 0 m/s"),
    ],
)
def test_what_is_no_turbsim_field(tmp_path, content, message):
    (tmp_path / "a.bts").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_bts(tmp_path / "a.bts")


def test_mann_box(tmp_path):
    """z is fastest; the middle of the box is y = 0."""
    shape, spacing = (4, 3, 2), (5.0, 4.0, 3.0)
    values = np.random.default_rng(0).normal(size=(3, *shape)).astype("<f4")
    for name, one in zip("uvw", values, strict=True):
        (tmp_path / f"box_{name}.bin").write_bytes(one.tobytes())
    found = read_mann(tmp_path / "box_u.bin", shape, spacing, 30.0)
    for name, one in zip("uvw", values, strict=True):
        np.testing.assert_array_equal(found[name], one)
    np.testing.assert_array_equal(found["y"], [-4, 0, 4])
    np.testing.assert_array_equal(found["z"], [30, 33])
    assert float(found["w"].sel(x=10, y=4, z=33)) == values[2, 2, 2, 1]
    with pytest.raises(InputError, match="has 96 bytes; expected 128 of 4 x 4 x 2 nodes"):
        read_mann(tmp_path / "box_u.bin", (4, 4, 2), spacing, 30.0)
    with pytest.raises(InputError, match="expected the file of u"):
        read_mann(tmp_path / "box_w.bin", shape, spacing, 30.0)
    (tmp_path / "box_v.bin").unlink()
    with pytest.raises(InputError, match=r"box_v\.bin: No such file"):
        read_mann(tmp_path / "box_u.bin", shape, spacing, 30.0)
