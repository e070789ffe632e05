"""A run in memory and what it shows of itself. System tier.

Detects: a run without a folder that writes a file, a file beside the experiment that is not found,
numbers that are not those of the metrics, a result that a notebook or a terminal cannot show.
"""

import webbrowser

import pytest
from rich.console import Console

import lidar_mi as lm
from lidar_mi.experiment import results
from lidar_mi.schema.reading import dump
from tests.support.experiments import check, small, write_wake

WORDS = "name: windy\nwake: {file: mine.nc}\nrender: {samples_per_beam: 4, max_order: 1}\n"


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A small run in memory; its only file is that of the wake, beside the experiment."""
    folder = tmp_path_factory.mktemp("run")
    write_wake(folder / "mine.nc", lambda y, z: 1.0 + 0.0 * y * z)
    (folder / "windy.yaml").write_text(WORDS)
    experiment = lm.load_experiment(folder / "windy.yaml", **{"retrieval.methods": ["cc"]})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("elsewhere"))

        return lm.run(experiment, notice=lambda text, fraction: None)


@pytest.mark.slow
def test_a_run_without_a_folder_writes_nothing(done):
    assert [path.name for path in sorted(done.experiment.folder.iterdir())] == [
        "mine.nc",
        "windy.yaml",
    ]
    assert done.folder is None
    assert len(done.scans) == 2 and done.truth is not None
    assert done.wind["v"].sel(source="backscatter").notnull().any()


def test_it_shows_its_numbers(done):
    output = repr(done)
    assert output == str(done)
    for name in ("v", "w"):
        assert f"{done.metrics[f'backscatter.cc.rmse_{name}']:.2f}" in output
    assert "windy" in output and "no skill" in output
    page = done._repr_html_()
    assert page.startswith('<img alt="" style="max-width: 100%" src="data:image/png;base64,iVBOR')
    assert f">{done.metrics['backscatter.cc.rmse_v']:.2f}</td>" in page


def test_images_alone_are_judged_in_v_and_w(done):
    """A wind that does not vary leaves no skill to show; u needs a second lidar."""
    (verdict,) = [line for line in done.answer if "flight control" in line]
    assert "not judged: error of u (needs a Doppler lidar)" in verdict
    skills = [
        done.metrics[f"backscatter.cc.rmse_{n}"] < done.metrics[f"true_wind.rms_{n}"] for n in "vw"
    ]
    assert [f"error of {n} (" in verdict for n in "vw"] == [not skill for skill in skills]
    assert not any("line-of-sight" in line for line in done.answer)


def test_show_prints_and_opens_the_report(done, monkeypatch, capsys, tmp_path):
    opened = []
    monkeypatch.setattr(webbrowser, "open_new_tab", opened.append)
    done.show()
    assert capsys.readouterr().out == f"{done}\n" and opened == []
    monkeypatch.setattr(done, "folder", tmp_path)
    done.show()
    assert opened == [(tmp_path / "report.html").resolve().as_uri()]


def test_show_displays_in_a_notebook(done, monkeypatch):
    display = pytest.importorskip("IPython.display", reason="IPython is not installed")
    shown = []
    monkeypatch.setattr(display, "display", shown.append)
    monkeypatch.setattr(Console, "is_jupyter", True, raising=False)
    monkeypatch.setattr(results, "Console", lambda: type("_", (), {"is_jupyter": True})())
    done.show()
    assert shown == [done]


def test_progress_is_shown_unless_someone_listens(done, monkeypatch, capsys):
    """One line a step where standard error is no terminal."""
    steps = []

    def complete(prepared, folder, *, overwrite):
        prepared.log("rendering")
        return prepared

    monkeypatch.setattr("lidar_mi.experiment.run.complete", complete)
    lm.run(done.experiment)
    assert "rendering" in capsys.readouterr().err.splitlines()
    lm.run(done.experiment, notice=lambda text, fraction: steps.append(text))
    assert capsys.readouterr().err == "" and "rendering" in steps


def test_an_experiment_shows_changed_keys():
    experiment = check(small("shown", spacing=0.25) | {"seed": 3})
    output = repr(experiment).splitlines()
    assert output[0] == "experiment shown; keys without their default"
    keys = {line.split()[0]: " ".join(line.split()[1:]) for line in output[1:]}
    assert keys["wake.spacing"] == "0.25 m" and keys["seed"] == "3"
    assert keys["render.samples_per_beam"] == "8"
    assert not any(key.startswith(("scan.", "platform.")) for key in keys)
    assert "name: shown" in dump(experiment)


@pytest.mark.slow
def test_nodes_that_single_precision_cannot_hold(tmp_path):
    """Nodes 0.3 m apart: images read from their files are on those of the truth all the same."""
    data = small(spacing="0.3 m")
    data["wake"]["vortex_pair"] |= {"height": 21}
    data["retrieval"] |= {"stride": 8}
    found = lm.run(check(data), tmp_path / "out", notice=lambda text, fraction: None)
    assert found.wind["flag"].dtype.kind == "u"
    wind = found.wind.sel(source=["extinction", "backscatter"])
    # the truth stands where a vector was found: in all places but a few without an error
    assert (wind["v_true"].notnull() == wind["v"].notnull()).all()
    assert float(wind["v_true"].notnull().mean()) > 0.95
    assert (found.scans[1]["y"] == found.truth.wind["y"].values).all()
