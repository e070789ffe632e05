"""The report as a page. Detects names that become markup, a map whose numbers are not the wind's,
and (in a browser, where there is one) a map that tells nothing when it is pointed at."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr

from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.report.page import Chapter, Tables, page
from lidar_mi.assessment.report.vector_map import map_data
from lidar_mi.atmosphere.vortices.cores import Core
from lidar_mi.io.images import panel_cuts
from lidar_mi.schema import reading as config

EVIL = "</script><script>alert(1)</script>&\"'"


def some_wind(columns=6, rows=4):
    y, z = np.arange(columns) * 2.0 - 5, np.arange(rows) * 2.0
    vertical, lateral = np.meshgrid(z, y, indexing="ij")
    fields = {"v": 1.0 + 0 * lateral, "w": lateral / 4, "u": vertical}
    data = xr.Dataset(
        {name: (("z", "y"), field) for name, field in fields.items()}, {"z": z, "y": y}
    )
    for name in fields:
        data[f"{name}_true"] = data[name] - 0.5
        data[f"{name}_stderr"] = 0 * data[name] + 0.25
    flag = np.zeros((rows, columns), np.uint8)
    flag[0, 0], flag[1, 2] = 3, 2
    about = {"flag_masks": np.array([1, 2], np.uint8), "flag_meanings": "no_crossflow beyond_lines"}
    data["flag"] = ("z", "y"), flag, about
    return data


def some_page(**chapter):
    experiment = config.check(
        {"name": "x", "wake": {"file": f"{EVIL}.nc"}, "scattering": {"phase": "rayleigh"}}, "x"
    )
    numbers = Tables(EVIL, EVIL, [(EVIL, [EVIL], [(EVIL, EVIL, [EVIL])])])
    chapter = {"title": EVIL, "lead": [EVIL], "drawn": [], "numbers": numbers} | chapter
    return page(
        experiment, f"file: {EVIL}", {EVIL: EVIL}, {f"a.{EVIL}": 1.0}, [Chapter(**chapter)], [EVIL]
    )


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.scripts, self.words = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)

    def handle_data(self, data):
        (self.scripts if self.tags and self.tags[-1] == "script" else self.words).append(data)

    def handle_endtag(self, tag):
        self.tags.append(f"/{tag}")


def test_names_are_never_markup(tmp_path):
    from PIL import Image

    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    wind = some_wind()
    wind["flag"].attrs["flag_meanings"] = "no_crossflow " + EVIL.replace(" ", "")
    vectors = {"title": EVIL} | map_data(wind, ("u", "v", "w"), [])
    text = some_page(
        vectors=vectors,
        drawn=[Drawn(tmp_path / "a.png", EVIL, EVIL)],
        verdict=Tables(EVIL, EVIL, []),
    )
    assert "alert(1)" in text and "<script>alert" not in text
    found = Tags(text)
    # the data and the programs, nothing else
    assert found.tags.count("script") == 3
    assert json.loads(found.scripts[0])["title"] == EVIL
    assert sum(EVIL in word for word in found.words) >= 10


def test_the_map_holds_the_wind():
    wind = some_wind()
    data = map_data(wind, ("u", "v", "w"), [Core(1.234, 2.0, 3.0, 400.0)])
    assert [part["name"] for part in data["components"]] == ["u", "v", "w"]
    # row by row from below
    at = data["y"].index(3.0) + 6
    assert (data["y"][at], data["z"][at]) == (3.0, 2.0)
    u, _, w = data["components"]
    assert (u["retrieved"][at], u["true"][at], u["stderr"][at]) == (2.0, 1.5, 0.25)
    assert w["retrieved"][at] == 0.75
    assert data["flag"][0] == 3 and data["flag"][8] == 2 and sum(map(bool, data["flag"])) == 2
    assert data["flags"] == {"1": "no crossflow", "2": "beyond lines"}
    assert data["cores"] == [[1.23, 2.0]] and data["step"] == 2.0


def test_the_map_accepts_missing_vectors():
    """No standard errors, no number at some places, vectors off their nodes, too many of them."""
    wind = some_wind(220, 9).drop_vars(["u", "u_true", "u_stderr", "v_stderr"])
    wind["v"][4, 30] = np.nan
    wind["w_stderr"][:] = np.nan
    wind["y_vector"] = ("z", "y"), np.broadcast_to(wind["y"].values + 0.25, wind["v"].shape).copy()
    data = map_data(wind, ("v", "w"), [])
    v, w = data["components"]
    assert v["stderr"] is None and set(w["stderr"]) == {None}
    assert len(data["y"]) == 55 * 2 and data["step"] == 8.0
    assert min(data["y"]) == -5 + 2 * 2.0 + 0.25
    text = json.dumps(data, allow_nan=False)
    assert len(text) < 10_000 and None in v["retrieved"] + w["stderr"]


def test_the_first_page_has_the_answer_an_image_and_the_files(tmp_path):
    from PIL import Image

    drawn = [Drawn(tmp_path / f"{name}.png", name, "") for name in ("one", "two")]
    for figure in drawn:
        Image.new("RGB", (4, 4)).save(figure.path)
    text = some_page(drawn=drawn, verdict=Tables("Compliance", "", []))
    head, rest = text.split("</section>")
    assert head.index('class="answer"') < head.index('alt="one."') < head.index("Compliance")
    assert 'alt="one."' not in rest and 'alt="two."' in rest and 'alt="two."' not in head


@pytest.mark.parametrize(("panels", "cuts"), [(1, 0), (2, 1), (3, 2)], ids=["one", "two", "three"])
def test_panels_side_by_side_are_separated(tmp_path, panels, cuts):
    """Panels of 100 px, 10 px apart; none where something spans them."""
    from PIL import Image

    pixels = np.full((110, 110 * panels + 10), 255, np.uint8)
    for k in range(panels):
        pixels[5:105, 110 * k + 10 : 110 * k + 110] = 90
    Image.fromarray(pixels).save(tmp_path / "a.png")
    found = panel_cuts(tmp_path / "a.png")
    assert len(found) == cuts
    for k, cut in enumerate(found, 1):
        assert 110 * k < cut * pixels.shape[1] < 110 * k + 10
    pixels[1] = 0
    Image.fromarray(pixels).save(tmp_path / "b.png")
    assert panel_cuts(tmp_path / "b.png") == []


BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no Chromium here")
def test_a_browser_draws_the_map_and_describes_a_vector(tmp_path):
    vectors = {"title": "wind"} | map_data(some_wind(), ("u", "v", "w"), [Core(1.0, 0.0, 1.0, 9.0)])
    path = tmp_path / "report.html"
    path.write_text(some_page(vectors=vectors))
    done = subprocess.run(
        [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", path.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    dom = done.stdout
    where = r'<p class="where" role="status">y = 1.0 m, z = 4.0 m: valid, v 1.00, w 0.25 m/s</p>'
    assert where in dom
    rows = re.search("<tbody>(<tr><td>u.*?)</tbody>", dom)[1]
    assert "<td>u</td><td>4.00</td><td>3.50</td><td>0.50</td><td>0.25</td>" in rows
    assert "<td>w</td><td>0.25</td><td>-0.25</td><td>0.50</td><td>0.25</td>" in rows
    assert dom.count("<option") == 5 and '<div class="map">' in dom


# pins by a click, crosses three flagged vectors by an arrow key, is not moved by the pointer
ACTS = """<script>
  const canvas = document.querySelector(".map canvas"), box = canvas.getBoundingClientRect();
  const told = document.querySelector(".map .where"), heard = [];
  const at = (type, x) => canvas.dispatchEvent(new MouseEvent(type,
    { clientX: box.left + 46 + x * (box.width - 47), clientY: box.top + 20 }));
  const key = name => canvas.dispatchEvent(new KeyboardEvent("keydown", { key: name }));
  const hear = () => heard.push(
    told.textContent.split(":")[0] + told.textContent.includes("pinned"));
  at("pointermove", 0.01); hear();
  at("click", 0.01); hear();
  at("pointermove", 0.99); hear();
  key("ArrowRight"); hear();
  key("Escape"); hear();
  at("pointermove", 0.01); hear();
  document.body.append(Object.assign(
    document.createElement("p"), { id: "heard", textContent: heard.join("; ") }));
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no Chromium here")
def test_a_browser_pins_vectors_and_crosses_gaps(tmp_path):
    wind = some_wind()
    wind["flag"][:] = 0
    wind["flag"][:, 2:5] = 2
    vectors = {"title": "wind"} | map_data(wind, ("u", "v", "w"), [])
    path = tmp_path / "report.html"
    path.write_text(some_page(vectors=vectors).replace("</body>", f"{ACTS}</body>"))
    done = subprocess.run(
        [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", path.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    heard = re.search('<p id="heard">(.*?)</p>', done.stdout)[1].split("; ")
    assert heard == [
        "y = 5.0 m, z = 6.0 mfalse",
        "y = 5.0 m, z = 6.0 mtrue",
        "y = 5.0 m, z = 6.0 mtrue",
        "y = -3.0 m, z = 6.0 mtrue",
        "y = -3.0 m, z = 6.0 mfalse",
        "y = 5.0 m, z = 6.0 mfalse",
    ]
