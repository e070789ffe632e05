"""Scans as EXR files, read back by us, by plain OpenEXR and by real tools.

Detects: a flipped or transposed image, a layer under another's name, any bit of float32 lost.
"""

import errno
import math
import os
import re
import shutil
import subprocess

import numpy as np
import OpenEXR
import pytest
import xarray as xr

from lidar_mi.errors import InputError
from lidar_mi.io.exr import QUANTITIES, label_scan, read_layers, read_scan, write_scan

ATTRIBUTES = {
    "software": "lidar-mi 0.0",
    "seed": 2**31 - 1,
    "gate_start": 500.5,
    "stokes_emitted": [1.0, 0.5, 0.0, -0.25],
    "beam_cut": math.inf,
    "gate_kind": "planar",
}


def make_scan(gates=2, rows=5, columns=7, seed=0, **attributes):
    rng = np.random.default_rng(seed)
    variables = {
        name: (("gate", "z", "y"), rng.normal(size=(gates, rows, columns)).astype(np.float32))
        for name in QUANTITIES
    }
    variables["Y"] = (("z", "y"), rng.random((rows, columns)).astype(np.float32))
    # values that float32 holds exactly
    y, z = 0.5 * np.arange(columns) - 1.5, 0.25 * np.arange(rows) - 60.0
    return label_scan(
        xr.Dataset(
            variables, {"gate": np.arange(gates), "y": y, "z": z}, attrs=ATTRIBUTES | attributes
        )
    )


def test_products_keep_their_meaning(tmp_path):
    """Names of layers that are no Stokes component, and whether an error is a bound."""
    scan = make_scan(depolarization_stderr_is_bound=1)
    for name in ("depolarization", "depolarization_stderr", "S1_stderr", "order2.S0"):
        scan[name] = scan["S0"] + 1
    write_scan(tmp_path / "scan.exr", label_scan(scan))
    again = read_scan(tmp_path / "scan.exr")
    meaning = {name: variable.attrs["long_name"] for name, variable in again.data_vars.items()}
    assert meaning["depolarization"] == "linear depolarisation ratio"
    assert meaning["depolarization_stderr"].startswith("upper bound of the standard error of the")
    assert meaning["S1_stderr"] == "Monte Carlo standard error of S1"
    assert meaning["order2.S0"] == "S0 of scattering order 2"


@pytest.mark.parametrize(
    ("gates", "rows", "columns"),
    # 2, 3, 4, 9 and 16 values have types of their own in a header: vectors and matrices
    [(1, 1, 1), (1, 2, 3), (3, 4, 9), (2, 16, 5), (12, 3, 2), (1, 139, 219)],
)
def test_round_trip_is_exact(tmp_path, gates, rows, columns):
    scan = make_scan(gates, rows, columns)
    path = tmp_path / "scan.exr"
    write_scan(path, scan)
    again = read_scan(path)
    xr.testing.assert_identical(again, scan)
    assert again["S0"].dtype == np.float32
    assert [p.name for p in tmp_path.iterdir()] == ["scan.exr"]


def test_a_thousand_gates_keep_their_order(tmp_path):
    scan = make_scan(gates=1001, rows=1, columns=2)
    write_scan(tmp_path / "scan.exr", scan)
    xr.testing.assert_identical(read_scan(tmp_path / "scan.exr"), scan)


def test_values_beyond_numbers_survive(tmp_path):
    scan = make_scan()
    scan["S0"][0, 0, 0], scan["S0"][0, 0, 1] = np.nan, np.inf
    scan["S1"][1, 2, 3] = 1e-42  # denormal
    write_scan(tmp_path / "scan.exr", scan)
    xr.testing.assert_identical(read_scan(tmp_path / "scan.exr"), scan)


def test_the_pilots_view(tmp_path):
    """The beam at largest z and largest y is the top left pixel of the plain file."""
    scan = make_scan(gates=1, rows=4, columns=6)
    scan["S0"][:] = 0
    scan["S0"].loc[{"z": scan["z"].max(), "y": scan["y"].max()}] = 7
    scan["Y"][:] = 0
    scan["Y"].loc[{"z": scan["z"].min(), "y": scan["y"].max()}] = 9
    write_scan(tmp_path / "scan.exr", scan)
    with OpenEXR.File(str(tmp_path / "scan.exr"), separate_channels=True) as file:
        pixels = file.channels()["gate000.S0"].pixels
        y = file.channels()["Y"].pixels
    assert pixels.shape == (4, 6)
    assert pixels[0, 0] == 7 and pixels.sum() == 7
    assert y[-1, 0] == 9 and y.sum() == 9


def test_the_order_of_the_dataset_does_not_matter(tmp_path):
    """Axes descending or transposed: the file is the same."""
    scan = make_scan()
    write_scan(tmp_path / "one.exr", scan)
    write_scan(
        tmp_path / "two.exr", scan.sortby(["y", "z"], ascending=False).transpose("y", "gate", "z")
    )
    pixels = [read_layers(tmp_path / name)[1] for name in ("one.exr", "two.exr")]
    assert pixels[0].keys() == pixels[1].keys()
    for name, layer in pixels[0].items():
        assert np.array_equal(layer, pixels[1][name])
    xr.testing.assert_identical(read_scan(tmp_path / "two.exr"), scan)


def test_header_attributes_keep_their_types(tmp_path):
    write_scan(tmp_path / "scan.exr", make_scan())
    header, layers = read_layers(tmp_path / "scan.exr")
    for key, value in ATTRIBUTES.items():
        assert header[key] == value and type(header[key]) is type(value)
    assert set(layers) == {"Y"} | {f"gate00{g}.{q}" for g in (0, 1) for q in QUANTITIES}
    assert {layer.dtype for layer in layers.values()} == {np.dtype(np.float32)}


def test_scans_carry_names_and_units():
    scan = make_scan()
    assert all(scan[name].attrs["units"] == "1" for name in QUANTITIES)
    assert scan["Y"].attrs["units"] == "m-1 sr-1"
    assert scan["y"].attrs["units"] == scan["z"].attrs["units"] == "m"
    assert all(scan[name].attrs["long_name"] for name in (*QUANTITIES, "Y", "y", "z"))


class TestTools:
    """What others' programs say about a file of ours."""

    @pytest.fixture
    def run(self, tmp_path):
        write_scan(tmp_path / "scan.exr", make_scan(gates=2, rows=5, columns=7))

        def run(tool, package, *arguments):
            if shutil.which(tool) is None:
                pytest.skip(f"{tool} is not installed (Debian package {package})")
            return subprocess.run(
                [tool, *arguments, str(tmp_path / "scan.exr")],
                capture_output=True,
                text=True,
                check=True,
                timeout=60,
            ).stdout

        return run

    def test_exrheader(self, run):
        text = run("exrheader", "openexr")
        assert re.search(r"dataWindow \(type box2i\): \(0 0\) - \(6 4\)", text)
        assert "compression (type compression): zip" in text
        for channel in ("Y", "gate000.S0", "gate000.S0_stderr", "gate001.S3"):
            assert f"    {channel}, 32-bit floating-point" in text
        assert 'software (type string): "lidar-mi 0.0"' in text
        assert "gate_start (type float): 500.5" in text
        assert f"seed (type int): {2**31 - 1}" in text
        assert re.search(r"^y \(type floatvector\)", text, re.MULTILINE)

    def test_iinfo(self, run):
        text = run("iinfo", "openimageio-tools", "-v")
        assert re.search(r"7 x +5, 11 channel, float openexr", text)
        assert "gate000.S0" in text and "gate001.S0_stderr" in text
        assert re.search(r'gate_kind: "planar"', text)

    def test_oiiotool_reads_the_pixels(self, run):
        """Mean of every channel, in its own order, from another program."""
        text = run("oiiotool", "openimageio-tools", "--info", "-v", "--stats")
        names = re.search(r"channel list: (.*)", text)[1].split(", ")
        means = [float(v) for v in re.search(r"Stats Avg: (.*?)\(float\)", text)[1].split()]
        scan = make_scan(gates=2, rows=5, columns=7)
        assert len(names) == len(means) == 11
        for name, mean in zip(names, means, strict=True):
            gate, _, quantity = name.rpartition(".")
            values = scan[quantity] if not gate else scan[quantity][int(gate[4:])]
            assert mean == pytest.approx(float(values.mean()), abs=2e-6)


class TestErrors:
    def fault(self, path):
        with pytest.raises(InputError) as error:
            read_scan(path)
        text = str(error.value)
        assert text.startswith(f"{path}: ") and "\n" not in text
        return text

    def test_missing_file(self, tmp_path):
        assert "no such file; expected an OpenEXR image" in self.fault(tmp_path / "absent.exr")
        assert "no such file" in self.fault(tmp_path)  # a folder

    @pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n" + bytes(99)])
    def test_not_an_exr(self, tmp_path, content):
        path = tmp_path / "other.exr"
        path.write_bytes(content)
        assert "not a readable OpenEXR image" in self.fault(path)

    @pytest.mark.parametrize("fraction", [0.1, 0.5, 0.99])
    def test_cut_off(self, tmp_path, fraction):
        path = tmp_path / "scan.exr"
        write_scan(path, make_scan(rows=60, columns=70))
        content = path.read_bytes()
        path.write_bytes(content[: int(fraction * len(content))])
        assert "not a readable OpenEXR image" in self.fault(path)

    def foreign(self, path, header=None, **channels):
        pixels = np.ones((3, 4), np.float32)
        OpenEXR.File(
            {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            | (header or {}),
            {name: pixels for name in channels.get("names", "RGB")},
        ).write(str(path))

    def test_foreign_image(self, tmp_path):
        path = tmp_path / "rgb.exr"
        self.foreign(path)
        text = self.fault(path)
        assert (
            "are not a lidar scan; expected Y and, the same of every gate, gate000.S0" in text
            and "B, G, R" in text
        )
        # it is readable all the same
        _, layers = read_layers(path)
        assert set(layers) == set("RGB") and (layers["R"] == 1).all()

    @pytest.mark.parametrize("missing", ["Y", "gate000.S2", "gate001.S0_stderr", "y", "z"])
    def test_a_part_is_missing(self, tmp_path, missing):
        names = {"Y"} | {f"gate00{g}.{q}" for g in (0, 1) for q in QUANTITIES}
        axes = {"y": np.arange(4, dtype=np.float32), "z": np.arange(3, dtype=np.float32)}
        axes.pop(missing, None)
        path = tmp_path / "part.exr"
        self.foreign(path, axes, names=names - {missing})
        assert "are not a lidar scan" in self.fault(path)

    def test_axes_of_another_size(self, tmp_path):
        names = {"Y"} | {f"gate000.{q}" for q in QUANTITIES}
        axes = {"y": np.arange(5, dtype=np.float32), "z": np.arange(3, dtype=np.float32)}
        path = tmp_path / "other.exr"
        self.foreign(path, axes, names=names)
        assert "header attribute y of 5 numbers is no axis of 4 pixels" in self.fault(path)

    @pytest.mark.parametrize("y", ["port", 3.0, [0, 1, 1, 2], [0, 1, np.nan, 3], [3, 2, 1, 0]])
    def test_axes_that_are_none(self, tmp_path, y):
        names = {"Y"} | {f"gate000.{q}" for q in QUANTITIES}
        y = np.array(y, np.float32) if isinstance(y, list) else y
        path = tmp_path / "other.exr"
        self.foreign(path, {"y": y, "z": np.arange(3, dtype=np.float32)}, names=names)
        assert "is no axis of 4 pixels; expected as many finite numbers" in self.fault(path)

    def test_gates_that_differ(self, tmp_path):
        names = {"Y", "gate000.depolarization"}
        names |= {f"gate00{gate}.{q}" for gate in (0, 1) for q in QUANTITIES}
        axes = {"y": np.arange(4, dtype=np.float32), "z": np.arange(3, dtype=np.float32)}
        path = tmp_path / "gates.exr"
        self.foreign(path, axes, names=names)
        assert "the same of every gate" in self.fault(path)

    def test_more_pixels_than_a_file_can_hold(self, tmp_path):
        path = tmp_path / "large.exr"
        self.foreign(path, {}, names={"Y"})
        content = path.read_bytes()
        window = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
        large = np.array([0, 0, 29_999, 29_999], "<i4").tobytes()
        path.write_bytes(content[:window] + large + content[window + 16 :])
        assert "declares 3.6e+09 bytes in a file of" in self.fault(path)


def test_values_beyond_float32_are_not_written_as_infinity(tmp_path):
    scan = make_scan()
    scan["S0"] = scan["S0"].astype(float)
    scan["S0"][0, 0, 0] = 1e300
    with pytest.raises(InputError, match=r"gate000.S0 has values beyond 3.4e\+38"):
        write_scan(tmp_path / "scan.exr", scan)
    assert list(tmp_path.iterdir()) == []


class TestFailedWrites:
    def test_an_attribute_that_no_header_can_hold(self, tmp_path):
        with pytest.raises(RuntimeError, match="bad"):
            write_scan(tmp_path / "scan.exr", make_scan(bad=None))
        assert list(tmp_path.iterdir()) == []

    def test_a_write_that_stops_halfway(self, tmp_path, monkeypatch):
        """The disk fills up after the first bytes: no file, and an older one stays as it was."""
        path = tmp_path / "scan.exr"
        write_scan(path, make_scan(seed=1))
        before = path.read_bytes()

        def fail(_):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "fsync", fail)
        with pytest.raises(InputError, match="No space left"):
            write_scan(path, make_scan(seed=2))
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]
