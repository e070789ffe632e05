"""The validation: that it can fail, that its references are right, that its results are in date.

Detects: a row that passes with a wrong number or without any yardstick, a failure that does not end
in an error, a check or figure that the results lack or have too many, 1e-5 in the integral equation
that stands for steady states, stored numbers that belong to other cases than those asked for.

Checks that take seconds are run. All of them: `make validate`.
"""

import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
if not (ROOT / "validation").is_dir():
    pytest.skip("the validation is part of the source tree", allow_module_level=True)

from validation import GROUPS, TOLD, report
from validation import __main__ as command
from validation.report import Check, Row


@pytest.fixture
def effort(variant, tmp_path):
    scenes = import_module("validation.scenes")
    return scenes.Effort(folder=tmp_path)


def group(name):
    """A group's module; those that compute particles need the test libraries."""
    if name == "scattering_matrices":
        for package in ("scatrs", "rustmatrix", "miepython"):
            pytest.importorskip(package, reason=f"{package} (extra 'test') is not installed")
    return import_module(f"validation.{name}")


# --- rows


def test_a_row_passes_within_four_sigmas_and_its_tolerance():
    row = Row("a", "b", 1.0, 1.5, sigma=0.1, tolerance=0.1)
    assert row.passed and row.deviation == pytest.approx(5)
    assert not replace(row, got=1.51).passed and not replace(row, got=0.49).passed
    assert not replace(row, got=math.nan).passed
    exact = Row("a", "b", 1.0, 1.02, tolerance=0.01)
    assert not exact.passed and exact.deviation == pytest.approx(2)


@pytest.mark.parametrize(
    "yardstick", [{}, {"sigma": math.inf}, {"sigma": math.nan}, {"sigma": -1.0, "tolerance": 9.0}]
)
def test_a_row_without_a_yardstick_is_refused(yardstick):
    with pytest.raises(ValueError, match="not both 0"):
        Row("a", "b", 1.0, 1.0, **yardstick)


def test_a_check_without_rows_has_not_passed():
    assert not Check("a", "b", ()).passed


def test_largest_difference_sees_one_wrong_element():
    expected = np.arange(12.0).reshape(3, 4)
    got = expected.copy()
    assert report.largest("a", "b", got, expected, 1e-6).passed
    got[1, 2] += 1e-5
    assert not report.largest("a", "b", got, expected, 1e-6).passed
    got[1, 2] = np.nan
    assert not report.largest("a", "b", got, expected, 1e-6).passed


@pytest.mark.parametrize("batches", [8, 32, math.inf])
def test_spread_of_z_scores(batches):
    """Right scores pass, with the variance of Student's law; error bars off by a third do not."""
    random = np.random.default_rng(1)
    number = 8 if batches == 8 else 32
    values = random.standard_normal((number, 4000))
    mean, error = report.mean_and_error(values)
    z = mean / (error if math.isfinite(batches) else 1 / math.sqrt(number))
    assert report.spread("a", "b", z, batches).passed
    assert not report.spread("a", "b", z * 1.3, batches).passed
    assert not report.spread("a", "b", z / 1.3, batches).passed
    assert not report.spread("a", "b", z + 0.5, batches).passed
    sigma = report.spread("a", "b", z, batches).sigma
    repeated = (z.reshape(40, 100) ** 2).mean(1)
    assert repeated.std() == pytest.approx(sigma * math.sqrt(40), rel=0.5)


# --- checks that fail when they should


def test_a_wrong_cross_section_is_detected(effort, monkeypatch):
    molecules = group("molecules")
    assert all(check(effort).passed for check in molecules.CHECKS)
    right = molecules.molecules.cross_section
    monkeypatch.setattr(molecules.molecules, "cross_section", lambda *a: 1.0005 * right(*a))
    assert not molecules.cross_sections(effort).passed


def test_a_wrong_image_is_detected(effort, monkeypatch):
    """0.01 % too little Q."""
    equation = group("lidar_equation")
    assert equation.depolarisation(effort).passed
    right = equation.render

    def wrong(*given):
        found = right(*given)
        return found | {"S1": 0.9999 * found["S1"]}

    monkeypatch.setattr(equation, "render", wrong)
    assert not equation.depolarisation(effort).passed


def test_an_impossible_matrix_is_detected():
    """The coherency matrix of Rayleigh scattering is positive; a2 above a1 is not possible."""
    matrices = group("scattering_matrices")
    cosine = np.linspace(-1, 1, 21)
    even, odd = 0.75 * (1 + cosine**2), -0.75 * (1 - cosine**2)
    elements = np.stack([even, even, 1.5 * cosine, 1.5 * cosine, odd, 0 * cosine], axis=1)
    assert np.linalg.eigvalsh(matrices.coherency(elements)).min() > -1e-12
    for column, factor in ((1, 1.01), (2, 1.01), (4, 1.01)):
        wrong = elements.copy()
        wrong[:, column] *= factor
        assert np.linalg.eigvalsh(matrices.coherency(wrong)).min() < -1e-3


# --- references


def test_integral_equation_of_a_thick_slab_is_chandrasekhars():
    """Half-space, normal incidence: reflectance 1 - H(1) (1 - albedo)^1/2 (Chandrasekhar 1950)."""
    steady = group("steady_state")
    albedo = 0.8
    node, weight = np.polynomial.legendre.leggauss(64)
    node, weight = (node + 1) / 2, weight / 2
    h = np.ones(64)

    def next_h(mu, h):
        integral = (weight * node * h / (mu[:, None] + node)).sum(1)
        return 1 / (math.sqrt(1 - albedo) + albedo / 2 * integral)

    for _ in range(200):
        h = next_h(node, h)
    exact = 1 - next_h(np.array([1.0]), h)[0] * math.sqrt(1 - albedo)
    source, edge = steady.source_functions(albedo, 100, thickness=20.0, cells=2000)
    assert steady.leaving(source, edge, 0.0).sum() == pytest.approx(exact, abs=1e-5)


def test_stored_numbers_belong_to_the_cases():
    script = import_module("validation.eradiate_reference")
    eradiate = import_module("validation.eradiate")
    stored = json.loads(eradiate.STORED.read_text())
    assert {
        name: (c["phase"], c["max_order"]) for name, c in stored["cases"].items()
    } == script.CASES
    assert stored["albedo"] == script.ALBEDO and stored["cone_half_angle"] == script.CONE
    for case in stored["cases"].values():
        assert 0 < case["stderr"][0] < 3e-3 * case["stokes"][0]
    assert stored["command"] in eradiate.provenance()
    assert all(v in eradiate.provenance() for v in stored["versions"].values())
    assert stored["command"] not in eradiate.provenance("python")


# --- the command


def fake_run(name, effort):
    if name == "molecules":
        raise RuntimeError("broke")
    value = 2.0 if name == "gradients" else 1.0
    row = Row("one | of", "two", 1.0, value, tolerance=0.1)
    return f"Title {name}", "Text.", [Check(f"Check {name}", "More.", (row,), name=f"{name}.one")]


@pytest.fixture
def quick(monkeypatch, tmp_path):
    monkeypatch.setattr(command, "run", fake_run)
    monkeypatch.setattr(command, "fresh_process", lambda: ThreadPoolExecutor(1))
    return tmp_path


def stored(folder, name):
    return report.load(folder / "validation" / "results" / f"{name}.json")


def test_command_ends_with_an_error_where_a_row_fails(quick, capsys):
    assert command.main(["lidar_equation", "-o", str(quick)]) == 0
    assert "FAILS" not in capsys.readouterr().out
    assert command.main(["gradients", "lidar_equation", "-o", str(quick)]) == 1
    assert "FAILS: Check gradients, one | of: expected 1, got 2" in capsys.readouterr().out


def test_command_continues_after_a_failing_group_and_stores_the_others(quick, capsys):
    assert command.main(["-o", str(quick)]) == 1
    printed = capsys.readouterr().out
    assert "broke" in printed and "Check gradients" in printed
    there = {path.stem for path in (quick / "validation" / "results").iterdir()}
    assert there == set(GROUPS) - {"molecules", "coverage"}


def test_comparison_is_printed_and_on_the_pages(quick, monkeypatch, capsys):
    table = report.Comparison(("receiver", "m/s"), (("rings", "0.1"),))

    def with_table(name, effort):
        title, text, (check,) = fake_run(name, effort)
        return title, text, [replace(check, comparison=table)]

    monkeypatch.setattr(command, "run", with_table)
    pages = [quick / "docs" / "accuracy.md", quick / "docs" / "experiments" / "wake.md"]
    pages[1].parent.mkdir(parents=True)
    begin, end = (f"<!-- lidar_equation.one: {what} -->" for what in ("begin", "end"))
    for hand in pages:
        hand.write_text(f"before\n{begin}\n| old |\n{end}\nafter\n")
    assert command.main(["lidar_equation", "-o", str(quick)]) == 0
    lines = "| receiver | m/s |\n| --- | --- |\n| rings | 0.1 |\n"
    assert lines in capsys.readouterr().out
    assert f"\n\n{lines}\n" in report.page(stored(quick, "lidar_equation"))
    for hand in pages:
        assert hand.read_text() == f"before\n{begin}\n\n{lines}\n{end}\nafter\n"


# --- what is stored


RESULTS = {path.stem: report.load(path) for path in (ROOT / "validation" / "results").iterdir()}
WITH_ROWS = sorted(set(GROUPS) - set(TOLD))


def test_every_group_has_its_results_and_its_page():
    assert set(RESULTS) == set(GROUPS) | set(TOLD)
    index = (ROOT / "docs" / "validation.md").read_text()
    for name, results in RESULTS.items():
        assert f"| [{results.title}](validation/{name}.md), `{name}` | " in index


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", WITH_ROWS)
def test_results_are_of_every_check_and_no_other(name):
    module = group(name)
    assert [one.name for one in RESULTS[name].checks] == [
        f"{name}.{check.__name__}" for check in module.CHECKS
    ]
    assert (RESULTS[name].title, RESULTS[name].introduction) == (module.TITLE, module.INTRODUCTION)


@pytest.mark.parametrize("name", WITH_ROWS)
def test_every_stored_row_passes(name):
    rows = [row for check in RESULTS[name].checks for row in check.rows]
    assert len(rows) > 5 and all(row.name and row.reference for row in rows)
    assert not [row for row in rows if not row.passed]


QUICK = (
    "air: statistics divergence regulations",
    "filaments: rings instability wakes",
    "lidar_equation: profile_through_layers surfaces_that_touch valley_of_extinction"
    " phase_functions depolarisation diffuse_targets",
    "loads: gusts response",
    "molecules: cross_sections refraction depolarisation density",
    "receivers: published",
    "scattering_matrices: laws prolate spheres small_spheroids shipped",
    "strips: on_the_axis lifting_line gust_and_roll",
)
"""Checks that take no more than seconds: the physics in these tables has no other tests."""


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("checks", QUICK, ids=lambda checks: checks.partition(":")[0])
def test_results_are_in_date(effort, checks):
    """The same rows again, and all of them pass."""
    module, *functions = checks.replace(":", "").split()
    for function in functions:
        made = getattr(group(module), function)(effort)
        (old,) = (one for one in RESULTS[module].checks if one.name == f"{module}.{function}")
        assert made.passed, [row for row in made.rows if not row.passed]
        for row, before in zip(made.rows, old.rows, strict=True):
            assert report._cells(before)[0] == report._cells(row)[0]
            assert before.reference == row.reference
            assert before.expected == pytest.approx(row.expected, rel=1e-5)
            allowed = 0.1 * (row.tolerance + row.sigma)
            assert before.got == pytest.approx(row.got, rel=1e-5, abs=allowed), row


def test_figures_are_there_and_small():
    shown = [
        name
        for results in RESULTS.values()
        for check in results.checks
        for name, _ in check.figures
    ]
    there = {path.name: path for path in (ROOT / "docs" / "validation").glob("*.png")}
    assert len(shown) == len(set(shown)) >= 5 and set(shown) == set(there)
    assert all(path.stat().st_size < 80_000 for path in there.values())
