"""Every kind of page and every figure of results against the same rules. System tier.

Detects: a panel without data, arrows without a scale, a 1:1 line on unequal axes, a mirrored view,
a text that is cut; pictures without what is seen in numbers, headings that jump, a table that
widens a narrow screen, text too faint in the light or the dark mode.
"""

import math
import re

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from lidar_mi.assessment.figures import encounter_film
from lidar_mi.assessment.figures.encounter import draw_all
from lidar_mi.assessment.report import campaign as campaign_report
from lidar_mi.assessment.report.encounter import encounter_chapter
from lidar_mi.assessment.report.page import Film, page
from lidar_mi.experiment import study
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.run import run
from lidar_mi.io.film import frame_as_webp
from lidar_mi.schema import reading as config
from tests.support import figure_rules, page_rules
from tests.support.campaign_results import campaign, sweep
from tests.support.encounter_results import made_up_flights
from tests.support.experiments import QUICK_DOPPLER
from tests.support.synthetic_lidar import encounter_keys

PAIR = {"vortex_pair": {"circulation": "400 m^2/s", "separation": "40 m"}}
SMALL_WAKE = {"circulation": 150, "separation": 16, "core_radius": 2, "width": 30, "height": 20}
COHERENT = {
    "laser": {"first_gate": "100 m", "gates": 40, "gate_spacing": "8 m", "gate_length": "10 m"},
    "signal": {"cnr": 20, "profile": "constant"},
    "position": ["0 m", "200 m", "2 m"],
    "passage": {"height": "60 m"},
}
EXPERIMENTS = {
    "both lidars": {
        "wake": {"vortex_pair": SMALL_WAKE | {"width": 60, "height": 40}, "spacing": "1 m"},
        "platform": {"speed": "70 m/s"},
        "scan": {"range": "148.75 m"},
        "lidar": {"pulse_duration": "10 ns"},
        "detector": {},
        "render": {"samples_per_beam": 32, "max_order": 2},
        "retrieval": {"methods": ["ws", "cc", "variational"], "stride": 2},
        "doppler": {"lidar": {"range": "150 m"}} | QUICK_DOPPLER,
        "sensor": {
            "directions": {
                "columns": 5,
                "rows": 3,
                "azimuth_half": "8 deg",
                "elevation_half": "4 deg",
            },
            "method": "variational",
            "crossflow_std": "0.8 m/s",
        },
    },
    "one method": {
        "wake": {"vortex_pair": SMALL_WAKE},
        "render": {"samples_per_beam": 8, "max_order": 1},
        "retrieval": {"methods": ["cc"]},
    },
    "slices": {
        "wake": PAIR,
        "doppler": COHERENT
        | {
            "kind": "coherent",
            "scan": {"count": 3, "elevations": ["0 deg", "30 deg"], "rate": "10 deg/s"},
        },
    },
    "lines in one direction": {
        "doppler": COHERENT | {"kind": "coherent", "scan": {"kind": "stare", "count": 12}},
        "wake": PAIR,
    },
    "winds over height": {
        "doppler": COHERENT
        | {"kind": "coherent", "scan": {"kind": "dbs", "count": 3, "repeat": "6 s"}},
        "wake": PAIR,
    },
}


LONG = ("both lidars", "lines in one direction")


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=[pytest.mark.slow] * (name in LONG), id=name)
        for name in EXPERIMENTS
    ],
)
def ran(request, tmp_path_factory):
    """Faults of the figures and text of the report of a small run."""
    folder = tmp_path_factory.mktemp("run") / "run"
    given = config.check({"name": "x"} | EXPERIMENTS[request.param], "x")
    with figure_rules.judged_figures() as found:
        run(given, folder)
    return found, (folder / "report.html").read_text()


def broken(found):
    return {name: faults for name, faults in found.items() if faults}


@pytest.mark.slow
def test_figures_of_a_run(ran):
    found, _ = ran
    assert found and broken(found) == {}


def test_report_of_a_run(ran):
    assert list(page_rules.faults(ran[1])) == []


def test_texts_say_what_is_seen(ran):
    """The longest vectors and where, or ranges of what is drawn, in every picture."""
    alts = re.findall(r'<img class="paper" alt="([^"]+)"', ran[1])
    assert alts and all(len(re.findall(r"\d", alt)) > 3 for alt in alts)
    if "wind retrieved from two such images" in alts[0]:
        assert re.search(r"arrows, the longest [\d.]+ m/s at \(-?[\d.]+ m, ", alts[0])
        assert "true cores at (" in alts[0]


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    found = made_up_flights()
    with figure_rules.judged_figures() as figures:
        drawn = draw_all(folder, found.series, found.track, found.slabs, 28.9, Log())
    canvas = encounter_film.FigureCanvasAgg
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(encounter_film, "RATE", 1)
        drawn_on = []
        patch.setattr(
            encounter_film,
            "FigureCanvasAgg",
            lambda figure: drawn_on.append(figure) or canvas(figure),
        )
        frames = [
            (frame_as_webp(frame.pixels), frame.caption)
            for frame in encounter_film.film(found.series, found.track, found.slabs, 28.9)
        ]
    figures["film"] = figure_rules.faults(*drawn_on)
    metrics = {"encounter.off.largest_roll": math.radians(25), "encounter.off.departed": 0.0}
    texts = [
        page(
            config.check(encounter_keys(), "test"),
            "name: x",
            {"lidar-mi": "0"},
            {},
            [encounter_chapter(metrics, [], drawn, shown)],
        )
        for shown in (
            Film("The flight", "Frames.", frames, 0.2),
            Film("The flight", "Frames.", frames, 0.2, b"film", "approach.gif"),
        )
    ]
    return figures, texts


@pytest.mark.slow
def test_figures_of_a_flight(flown):
    assert flown[0] and broken(flown[0]) == {}


def test_reports_of_a_flight(flown):
    for text in flown[1]:
        assert list(page_rules.faults(text)) == []


def sample():
    """Knobs, an error that they decide, and bank angles of flights."""
    unit = (np.arange(64) + 0.5) / 64
    coords = {"sample": ("sample", np.arange(64))}
    for name, values in (
        ("lidar.pulse_energy", 10 ** (4 * unit - 4)),
        ("wake.texture.rms", np.random.default_rng(3).permutation(unit)),
    ):
        coords[name] = ("sample", values, {"scale": "linear", "long_name": name})
    data = campaign(coords, ("sample",), 10 ** (1 - 2 * unit))
    for mode, factor in (("off", 1.0), ("autopilot", 0.5), ("feedforward", 0.2)):
        roll = (0.02 + unit) ** (2 - factor)
        data[f"encounter.{mode}.largest_roll"] = "sample", roll, {"units": "rad"}
    return data


LONG = "root mean square error of the lateral wind of all valid vectors beyond the cores"
CAMPAIGNS = {
    "a map": sweep,
    "a line": lambda: sweep().isel(range=1, drop=True),
    "a point": lambda: campaign({}, ("member",), np.linspace(1, 2, 4)),
    "a sample": sample,
    "long names": lambda: sweep(1).assign(
        {"sensor.rmse_v": sweep(1)["sensor.rmse_v"].assign_attrs(long_name=LONG)}
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", CAMPAIGNS)
def test_campaigns(kind):
    with figure_rules.judged_figures() as found:
        text = campaign_report.page(CAMPAIGNS[kind](), "name: test")
    assert found and broken(found) == {}
    assert list(page_rules.faults(text)) == []


def test_limits_are_drawn_in_maps():
    """The boundary of 3.16 mJ that the error has, in the map of the error as in that of rows."""
    text = campaign_report.page(sweep(), "name: test")
    block = text[text.index('id="block-1"') :]
    assert "Black lines: where the limit is reached." in block
    assert "flight control, landing" in block.split("</svg>")[0]


@pytest.mark.slow
def test_the_comparison_of_variants(tmp_path):
    described = {
        "name": "two",
        "wake": {"vortex_pair": SMALL_WAKE | {"width": 60, "height": 40}, "spacing": 1},
        "render": {"samples_per_beam": 16, "max_order": 1},
        "retrieval": {"methods": ["cc"], "stride": 2},
        "variants": {
            "near": {"scan": {"range": "150 m"}},
            "far": {"scan": {"range": "500 m"}},
            # no photoelectron, and so no valid vector
            "dark": {"lidar": {"pulse_energy": "1 pJ"}, "detector": {}},
        },
    }
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    with figure_rules.judged_figures() as found, pytest.MonkeyPatch.context() as patch:
        patch.setattr("lidar_mi.assessment.figures.backscatter.draw_all", lambda *_: [])
        patch.setattr("lidar_mi.experiment.stages.texture.LEVELS", ())
        study.run("two", config.load_variants(tmp_path / "two.yaml"), tmp_path / "out")
    assert "fig00_comparison" in found and broken(found) == {}
    text = next((tmp_path / "out").glob("*.html")).read_text()
    assert "Without a valid vector, and so by its image alone: dark." in text
    assert list(page_rules.faults(text)) == []


def test_rules_find_what_they_are_for():
    """A figure and a page that break each of them."""
    figure = Figure()
    left, middle, _ = figure.subplots(1, 3)
    left.quiver([0, 1], [0, 1], [1, 1], [1, 1])
    left.set(xlabel="y / m", ylabel="z / m", ylim=(1, 0))
    middle.plot([0, 1], [0, 1])
    middle.set(xlim=(0, 1), ylim=(0, 5), title="wider than its panel and than the figure " * 3)
    assert len(figure_rules.faults(figure)) == 6
    text = (
        "<style>:root { --text: #777; --page: #777; --muted: #000; --link: #000; --pass: #000; "
        "--fail: #000; --answer: #fff; --warning: #fff; --code: #fff; } :root { --a: #000; } "
        'p { width: 900px; }</style><h1>a</h1><h3 id="b">b</h3><img alt="a picture">'
        '<table id="b"></table><a href="#c"></a>'
    )
    found = " ".join(page_rules.faults(text))
    for word in ("outside of a box", "0 main", "language", "level 3 follows", "picture", "two ele"):
        assert word in found, word
    for word in ("#c", "width of 900px", "contrast of light text on page 1.00"):
        assert word in found, word
