"""Input that cannot work, and input that gives poor results.

Detects: bad input that is found only after files were written or told in more than one line, and an
experiment without any vector or vortex that does not warn of it."""

import numpy as np
import pytest

from lidar_mi.errors import InputError
from lidar_mi.experiment.run import run
from lidar_mi.io.vortex_file import read_vortices
from tests.support.experiments import check, small, write_wake


@pytest.mark.parametrize(
    "change, words",
    [
        ({"lidar": {"divergence_full": "0.4 rad"}, "scan": {"range": "50 km"}}, "scan.range: 500"),
        ({"lidar": {"pulse_duration": "10 ns"}, "detector": {"line_width": "1 MHz"}}, "line_width"),
        ({"scattering": {"phase": "table", "table": "no.txt"}}, "scattering.table: .*no.txt"),
        ({"retrieval": {"template": 30, "search": 60}}, "search: 60 px"),
        ({"scattering": {"albedo": 0}}, "albedo"),
        ({"wake": small(extinction={"background": 0})["wake"]}, "wake.extinction: 0 everywhere"),
        ({"wake": {"file": "no.nc"}}, "wake.file: no.nc not found"),
        ({"wake": {"file": "text.nc"}}, "text.nc: is not NetCDF"),
    ],
)
def test_bad_input_is_reported_before_anything_is_written(tmp_path, change, words):
    (tmp_path / "text.nc").write_text("no NetCDF")
    with pytest.raises(InputError, match=words) as caught:
        run(check(small() | change), tmp_path / "run", beside=tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_volume_needs_a_plane_when_one_is_to_be_extruded(tmp_path):
    name = write_wake(tmp_path / "v.nc", lambda x, y, z: y * 0 + 1, x=np.arange(0.5, 4))
    data = small()
    data["wake"] = {"file": name}
    with pytest.raises(InputError, match=r"wake\.x: missing; v\.nc has 4 planes"):
        run(check(data), tmp_path / "run", beside=tmp_path)


def test_gates_that_reach_beyond_the_wake(tmp_path):
    """The first of four planes of 1 m in the middle of 2.5 m gates: they begin 0.75 m before it."""
    name = write_wake(tmp_path / "v.nc", lambda x, y, z: y * 0 + 1, x=np.arange(0.5, 4))
    data = small()
    data["wake"] = {"file": name, "depth": "volume", "x": 0.5, "texture": {"rms": 0}}
    with pytest.raises(InputError, match=r"gates from 500 to 502.5 m .* fill 500.75 to 504.75 m"):
        run(check(data), tmp_path / "run", beside=tmp_path)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_beams_wider_than_a_template_are_reported(tmp_path, quick):
    """At 5 km the paper's beam is 10 m wide, a template 4 m: nothing is left to follow, as the
    report states."""
    reported = []
    data = small() | {"scan": {"range": "5 km"}}
    metrics = run(
        check(data), tmp_path / "run", notice=lambda text, _: reported.append(text)
    ).metrics
    warnings = [text for text in reported if text.startswith("warning: ")]
    # eight samples of such a beam: in a quarter of the pixels one carries the variance
    untrusted = [text for text in warnings if "one Monte Carlo sample carries half" in text]
    assert [text.split(": ")[1] for text in untrusted] == ["image_t1", "image_t2"]
    warnings = [text for text in warnings if text not in untrusted and "masked: " not in text]
    assert len(warnings) == 3
    assert "beams are 10 m wide at 5001" in warnings[0] and "template of 4 m" in warnings[0]
    assert "backscatter, cc: no vector is valid; 100 % have the flag " in warnings[1]
    # a few samples of a beam of 5 km
    assert "render.samples_per_beam: no vector is valid with as much noise again" in warnings[2]
    assert metrics["backscatter.cc.valid_fraction"] == 0
    page = (tmp_path / "run" / "report.html").read_text()
    log = (tmp_path / "run" / "log.txt").read_text()
    for text in warnings:
        assert text.removeprefix("warning: ") in page and text in log


@pytest.mark.slow
def test_air_without_vortices_is_reported(tmp_path, quick):
    """Nothing turns: the report says that, and shows the rest."""
    data = small(texture={"rms": 0.3, "outer_scale": "5 m"})
    data["wake"]["vortex_pair"]["circulation"] = 1e-3
    data["retrieval"] = {"methods": ["vortex_fit"]}
    metrics = run(check(data), tmp_path / "run").metrics
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Warning: no vortex pair from the images: " in page
    assert "No pair from the images: " in page and "Vortex parameters and standard errors" in page
    assert not [key for key in metrics if key.startswith("vortex.")]
    assert read_vortices(tmp_path / "run" / "vortex.json") == {}
    assert "vortex fit" in page
