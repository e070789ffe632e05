"""The report of a campaign, from data sets that are made here.

Detects: a figure without links, a link that leads elsewhere, failed points that are not to be seen,
a boundary that the text and the figure do not state, text of the user that becomes markup.
"""

import re

import numpy as np
import pytest

from lidar_mi.assessment.labels import title_of
from lidar_mi.assessment.metrics.campaign import spaced_by_factors
from lidar_mi.assessment.report.campaign import answer, page
from lidar_mi.errors import InputError
from tests.support.campaign_results import campaign, sweep


def links(html):
    """Link and text of every point in every figure."""
    return set(
        re.findall(r'<a href="([^"]+)" data-point="\d+"><\w+ [^>]*><title>(.*?)</title>', html)
    )


def test_a_map_has_every_point_and_the_boundary():
    html = page(sweep(), "name: test")
    assert "12 points of wake_sensor with 4 members each: 47 of 48 runs done, 1 failed" in html
    found = links(html)
    # a cell links to the folder of its first member
    assert {link for link, _ in found} == {f"points/aa/{4 * k}/" for k in range(12)}
    texts = {text for _, text in found}
    assert "smallest margin +82 %" in texts  # at 100 mJ: 1 - sqrt(10^-1.5)
    assert "no rings &lt;b&gt;detected&lt;/b&gt;" in html and "<b>detected" not in html
    assert "test &lt;i&gt;" in html and not re.search(r'(src|href)="https?:', html)


def test_the_boundary_of_a_requirement_is_stated_with_its_interval():
    html = page(sweep().isel(range=1, drop=True), "name: test")
    # 1 % of an error that falls with the root of the energy: t(3) 1.29 % / 2 of the energy's 2 %
    stated = re.search(r"from ([\d.]+) J \(95 %: ([\d.]+) to ([\d.]+)\)", html)
    value, low, high = (float(one) for one in stated.groups())
    # between two decades the margin is interpolated in the logarithm: not exactly 3.16 mJ
    assert 0.002 < low < value < high < 0.005


def test_the_lead_says_where_requirements_are_not_met():
    few = sweep().isel(range=[1], energy=[0, 3])
    text = answer(few)
    where = "Not met for flight control, landing: range = 150 m, energy = 0.0001 J"
    assert f"at 1 of 2 points. {where}" in text
    assert re.search(r"\(error of v: margin -\d+ %\)\.$", text)
    many = answer(sweep())
    assert "Not met for flight control, landing at 6 points, most often error of v at 6" in many


def test_four_points_have_their_numbers():
    """In the cells and in a table, coverage beside the error; ticks are the values themselves."""
    data = sweep().isel(range=[0, 2], energy=[1, 2])
    covered = np.array([0.5, 0.93, 0.95, 0.97]).reshape(2, 2)[..., None]
    data["sensor.rmse_w"] = data["sensor.rmse_v"].copy()
    for name in "vw":
        key = f"sensor.coverage_95_{name}"
        data[key] = data["sensor.rmse_v"].dims, covered + np.zeros(4), {"long_name": title_of(key)}
    html = page(data, "name: test")
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", html)
    # 2.5 m/s at 3.16 mJ, falling with the root of the energy
    assert {"4.45", "1.41", "0.93", "75", "300", "1", "10"} <= set(texts)
    heads = re.findall(r'<th scope="col">(.*?)</th>', html[html.index('id="numbers"') :])
    assert heads[:2] == ["error of v / m/s", "coverage of 95 %, v, sensor"]
    rows = re.findall(r"<tr><td>(range.*?)</td><td[^>]*>(.*?)</td>", html)
    assert rows[0] == ("range = 75 m, energy = 1 mJ", "4.446\xa0±\xa00.029")
    assert answer(data).startswith(
        "Error of v: 1.41 to 4.45 m/s, least at range = 75 m, energy = 10 mJ; "
        "50 to 97 % of errors are within 1.96 standard errors"
    )


@pytest.mark.parametrize(
    ("values", "logarithmic"),
    [
        ([1, 2, 3, 10], True),
        (np.arange(1, 11), False),
        ([75, 150, 300], True),
        ([300, 150, 75], True),
        ([50, 100, 150], False),
        ([1, 9], True),
        ([50, 150], False),
        ([0, 1, 10, 100], False),
    ],
)
def test_axes_are_scaled_as_their_values(values, logarithmic):
    assert spaced_by_factors(np.array(values)) == logarithmic


def test_maps_of_positive_knobs_end_at_zero_or_above():
    data = sweep().isel(energy=[2, 3])
    del data["energy"].attrs["scale"]
    html = page(data.assign_coords(range=[1.0, 150.0, 300.0]), "name: test")
    assert "−" not in "".join(re.findall(r"<text[^>]*>([^<]*)</text>", html))


def test_lines_of_named_sets():
    data = sweep().isel(range=[0, 1]).drop_vars("range")
    data = data.rename(range="sky").assign_coords(sky=["day", "night"])
    html = page(data, "name: test")
    assert "day" in html and "night" in html and html.count("<svg") >= 1


def test_members_alone_are_shown_one_by_one():
    data = campaign({}, ("member",), np.linspace(1, 2, 4))
    html = page(data, "name: test")
    assert "over 3 members" in html
    assert {link for link, _ in links(html)} == {f"points/aa/{k}/" for k in range(4)}


def test_a_sample_has_indices_and_a_front():
    n = 64
    unit = (np.arange(n) + 0.5) / n
    other = np.random.default_rng(3).permutation(unit)
    coords = {
        "sample": ("sample", np.arange(n)),
        "lidar.pulse_energy": ("sample", 10 ** (4 * unit - 4), {"units": "J", "scale": "log"}),
        "wake.texture.rms": ("sample", other, {"scale": "linear"}),
    }
    data = campaign(coords, ("sample",), 10 ** (1 - 2 * unit))
    html = page(data, "name: test")
    assert "Of its logarithm. Sobol' indices with 95 % intervals" in html.replace("&#39;", "'")
    assert "Pareto front" in html and "not improved on in everything" in html
    # error falls with energy: every point but the failed one is on the front of both
    assert "63 of 63 points (orange)" in html


def test_a_sample_shows_where_requirements_are_met_over_the_knobs_that_decide():
    n = 64
    unit = (np.arange(n) + 0.5) / n
    random = np.random.default_rng(4)
    coords = {"sample": ("sample", np.arange(n))}
    for name, values in (
        ("idle", random.permutation(unit)),
        ("strong", unit),
        ("weak", random.permutation(unit)),
    ):
        coords[name] = ("sample", values, {"scale": "linear", "long_name": name})
    error = 2 * coords["strong"][1] + 1.5 * coords["weak"][1] + 0.5
    data = campaign(coords, ("sample",), error)
    html = page(data, "name: test")
    block = html[html.index("Where all rows are met") : html.index("rank correlation")]
    figure = html[html.index("rank correlation") :].partition("</svg>")[0]
    assert block and ">strong<" in figure and ">weak<" in figure and ">idle<" not in figure
    met = re.findall(r'fill="#2c7a3f" stroke="#2c7a3f"><title>smallest margin \+', figure)
    assert len(met) == (error[1:] <= 2.5).sum()
    assert "Pareto front" not in html  # no knob that costs anything


def test_a_kept_report_is_linked():
    html = page(sweep().assign_attrs(keep="everything"), "name: test")
    assert "points/aa/4/run/report.html" in {link for link, _ in links(html)}


def test_an_unknown_metric_is_refused():
    with pytest.raises(InputError, match=r"sensor\.rmse_x"):
        page(sweep(), "name: test", ["sensor.rmse_x"])


def test_quantities_are_in_the_units_that_people_use():
    """Angles in degrees, pulses in mJ; what was collected stays in SI."""
    dataset = sweep(1)
    angle = (
        "range",
        np.radians([10.0, 20.0, 40.0]),
        {"units": "rad", "long_name": "crossing angle"},
    )
    small = 0.02 * dataset["energy"]
    dataset = dataset.assign_coords(range=angle, energy=small.assign_attrs(dataset["energy"].attrs))
    html = page(dataset, "name: test")
    assert "10 to 40 deg" in html and "0.002 to 2 mJ" in html
    assert "crossing angle / deg" in html and " rad" not in html.split("name: test")[0]
    assert dataset["range"].attrs["units"] == "rad"


def test_points_with_noise_of_the_simulation_are_counted_first():
    """An error of 0.5 m/s of which 0.3 is the simulation's: 36 % of its square. Points that lack
    the number have a part as small as asked for."""
    data, head = sweep(1).isel(member=0), "backscatter_noisy.variational."
    found = np.full((3, 4), np.nan)
    found[1, 2], found[0, 1], found[2, 3] = 0.3, 0.2, 0.05
    for name in "vw":
        data[f"{head}rmse_{name}"] = ("range", "energy"), np.full((3, 4), 0.5)
        data[f"{head}monte_carlo_{name}"] = ("range", "energy"), found
    text = answer(data)
    assert text.startswith("At 2 of 12 points, noise of the simulation, which a lidar does not")
    assert "up to 36 % (range = 150 m, " in text and "; render.samples_per_beam: auto or" in text
    for name in "vw":
        data[f"{head}outside_cores.rmse_{name}"] = data[f"{head}rmse_{name}"]
        data[f"{head}outside_cores.monte_carlo_{name}"] = 0.1 * data[f"{head}monte_carlo_{name}"]
    assert "noise of the simulation" not in answer(data)
