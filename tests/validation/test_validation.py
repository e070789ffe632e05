"""The validation: that it can fail, that its references are right, that its page is in date.

Detects: a row that passes with a wrong number or without any yardstick, a failure that does not end
in an error, a check or figure that the page lacks or has too many, 1e-5 in the integral equation
that stands for steady states, stored numbers that belong to other cases than those asked for.

What the checks themselves find is not tested here: that is `make validate`.
"""

import json
import math
import re
import stat
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

ROOT = Path(__file__).resolve().parents[2]
if not (ROOT / "validation").is_dir():
    pytest.skip("the validation is part of the source tree", allow_module_level=True)

from validation import GROUPS, SECTIONS, report
from validation import __main__ as command
from validation.report import Check, Row

PAGE = ROOT / "docs" / "validation.md"


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


def test_a_table_replaces_that_of_a_page_written_by_hand():
    table = report.Comparison(("a", "b"), (("1", "2"),))
    check = Check("a", "b", (), name="group.check", comparison=table)
    marks = "<!-- group.check: begin -->\n", "<!-- group.check: end -->"
    page = f"before\n{marks[0]}\nold\n\n{marks[1]}\nafter\n"
    new = report.with_table(page, check)
    assert new == f"before\n{marks[0]}\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\n{marks[1]}\nafter\n"
    assert report.with_table(new, check) == new
    other = replace(check, name="group.other")
    assert report.with_table(page, other) == page
    assert report.with_table(page, replace(check, comparison=None)) == page


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


@pytest.mark.slow
def test_wrong_light_transport_is_detected(effort, monkeypatch):
    """The independent simulation with 3 % more extinction, or 1 % less albedo."""
    scattering = group("multiple_scattering")
    other = np.stack([scattering.simulate(scattering.RAYLEIGH, 10_000, 3, s)[0] for s in range(32)])
    for wrong in ({"extinction": 0.0206}, {"albedo": 0.9}):
        case = replace(scattering.RAYLEIGH, **wrong)
        ours = np.stack([scattering.simulate(case, 10_000, 3, 99 + s)[0] for s in range(32)])
        rows = [
            scattering.difference("all", ours[..., 0].sum((1, 2)), other[..., 0].sum((1, 2))),
            report.spread(
                "z", "b", scattering.scores(ours[..., 0].sum(2), other[..., 0].sum(2)), 32
            ),
        ]
        assert not all(row.passed for row in rows), wrong
    again = np.stack(
        [scattering.simulate(scattering.RAYLEIGH, 10_000, 3, 500 + s)[0] for s in range(32)]
    )
    assert scattering.difference("all", again[..., 0].sum((1, 2)), other[..., 0].sum((1, 2))).passed


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


def test_first_order_of_the_integral_equation_by_quadrature():
    steady = group("steady_state")
    cone = math.cos(0.2)
    source, edge = steady.source_functions(0.9, 1)

    def out(mu):  # mu times the radiance of single scattering
        return 2 * math.pi * 0.9 / (4 * math.pi) * -math.expm1(-(1 + 1 / mu)) / (1 + 1 / mu)

    exact = quad(out, cone, 1)[0]
    assert steady.leaving(source, edge, cone)[0] == pytest.approx(exact, rel=2e-6)


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


def test_another_interpreter_is_called(tmp_path):
    eradiate = import_module("validation.eradiate")
    fake = tmp_path / "python"
    fake.write_text('#!/bin/sh\necho "{\\"asked\\": \\"$3\\"}" > "$5"\ntest -f "$1"\n')
    fake.chmod(fake.stat().st_mode | stat.S_IXUSR)
    assert eradiate.reference(str(fake), 2) == {"asked": str(2 * eradiate.SAMPLES)}


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
    return tmp_path / "validation.md"


def test_command_ends_with_an_error_where_a_row_fails(quick, capsys):
    assert command.main(["lidar_equation", "-o", str(quick)]) == 0
    assert "FAILS" not in capsys.readouterr().out and not quick.exists()
    assert command.main(["gradients", "lidar_equation", "-o", str(quick)]) == 1
    assert "FAILS: Check gradients, one | of: expected 1, got 2" in capsys.readouterr().out


def test_command_continues_after_a_failing_group_and_writes_no_page(quick, capsys):
    assert command.main(["-o", str(quick)]) == 1
    printed = capsys.readouterr().out
    assert "broke" in printed and "Check gradients" in printed and not quick.exists()


def test_page_lists_failures(quick, monkeypatch):
    monkeypatch.setattr(command, "GROUPS", ("lidar_equation", "gradients"))
    assert command.main(["--slow", "-o", str(quick)]) == 1
    text = quick.read_text()
    assert "Of 2 rows, 1 of 2 fail." in text and "make validate ARGS=--slow" in text
    assert "| one \\| of | 1 | 2 | \\|1.0e-01\\| | +10.0 | **FAIL** | two |" in text


def test_comparison_is_printed_and_on_the_page(quick, monkeypatch, capsys):
    table = report.Comparison(("receiver", "m/s"), (("rings", "0.1"),))

    def with_table(name, effort):
        title, text, (check,) = fake_run(name, effort)
        return title, text, [replace(check, comparison=table)]

    monkeypatch.setattr(command, "run", with_table)
    monkeypatch.setattr(command, "GROUPS", ("lidar_equation",))
    assert command.main(["-o", str(quick)]) == 0
    lines = "| receiver | m/s |\n| --- | --- |\n| rings | 0.1 |\n"
    assert lines in capsys.readouterr().out and f"\n\n{lines}\n" in quick.read_text()
    pages = [quick.parent / "accuracy.md", quick.parent / "experiments" / "wake.md"]
    pages[1].parent.mkdir()
    begin, end = (f"<!-- lidar_equation.one: {what} -->" for what in ("begin", "end"))
    for hand in pages:
        hand.write_text(f"before\n{begin}\n| old |\n{end}\nafter\n")
    assert command.main(["lidar_equation", "-o", str(quick)]) == 0
    for hand in pages:
        assert hand.read_text() == f"before\n{begin}\n\n{lines}\n{end}\nafter\n"


def test_command_names_unknown_arguments(capsys):
    with pytest.raises(SystemExit) as stop:
        command.main(["speed"])
    assert stop.value.code == 2 and "'speed' is none of" in capsys.readouterr().err


def test_group_that_runs_by_name_writes_its_section_alone(quick, monkeypatch):
    """Into a page that stays as it is; a new page keeps the section."""
    begin, end = "<!-- coverage: begin -->", "<!-- coverage: end -->"
    quick.write_text(f"before\n\n{begin}\nold\n{end}\n\nafter\n")
    assert command.main(["coverage", "-o", str(quick)]) == 0
    text = quick.read_text()
    assert text.startswith(f"before\n\n{begin}\n\n## Title coverage\n") and "old" not in text
    assert text.endswith(f"\n{end}\n\nafter\n")
    monkeypatch.setattr(command, "GROUPS", ("lidar_equation",))
    assert command.main(["-o", str(quick)]) == 0
    section = report.section_of(text, "coverage")
    assert "before" not in quick.read_text() and section in quick.read_text()


def test_short_run_of_all_groups_leaves_the_section_of_a_long_one(quick, monkeypatch, capsys):
    begin, end = "<!-- coverage: begin -->", "<!-- coverage: end -->"
    quick.write_text(f"{begin}\n\nof twelve seeds\n\n{end}\n")
    monkeypatch.setattr(command, "GROUPS", ("lidar_equation", "coverage"))
    assert command.main(["-o", str(quick)]) == 0
    short = quick.read_text()
    assert "of twelve seeds" in short and "Title coverage" not in short
    assert "Check coverage" in capsys.readouterr().out
    assert command.main(["--slow", "-o", str(quick)]) == 0
    slow = quick.read_text()
    assert "of twelve seeds" not in slow and slow.count("## Title coverage") == 1


# --- the page


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text()


@pytest.mark.usefixtures("variant")
def test_page_has_every_check_and_no_other(page):
    rest = [name for name in GROUPS if name not in SECTIONS]
    known = [f"{name}.{check.__name__}" for name in rest for check in group(name).CHECKS]
    assert re.findall(r"^<!-- (\w+\.\w+) -->$", page, re.MULTILINE) == known
    for name in GROUPS:
        assert f"\n## {group(name).TITLE}\n\n{group(name).INTRODUCTION}\n" in page


def rows(page):
    """Cells of all rows of checks, by the check's name."""
    found, name = {}, None
    for line in page.splitlines():
        if match := re.fullmatch(r"<!-- (\w+\.\w+) -->", line):
            name = match[1]
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if name and len(cells) == 7 and cells[5] not in ("", "---"):
            found.setdefault(name, []).append(cells)
    return found


def test_every_row_of_the_page_passes(page):
    found = [row for group_rows in rows(page).values() for row in group_rows]
    assert f"**Of {len(found)} rows, all {len(found)} pass.**" in page
    assert {row[5] for row in found} == {"pass"} and len(found) > 150
    for row in found:
        expected, got, sigma, deviation = row[1], row[2], row[3].strip("\\|"), row[4]
        assert all(row[:1] + row[6:]), row
        # the printed numbers agree with each other as far as their digits go
        off = (float(got) - float(expected)) / float(sigma)
        digits = 1e-5 * max(abs(float(expected)), abs(float(got))) / float(sigma)
        assert off == pytest.approx(float(deviation), rel=0.06, abs=0.06 + digits), row


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    "name",
    [
        "molecules.cross_sections",
        "molecules.depolarisation",
        "strips.lifting_line",
        "scattering_matrices.laws",
        pytest.param("receivers.published", marks=pytest.mark.slow),
    ],
)
def test_page_is_in_date(page, effort, name):
    """Quick checks without chance: the same rows again."""
    module, _, function = name.partition(".")
    made = getattr(group(module), function)(effort)
    printed = rows(page)[name]
    assert [row[0] for row in printed] == [report._cells(row)[0] for row in made.rows]
    for row, line in zip(made.rows, printed, strict=True):
        assert line[6] == row.reference
        assert float(line[1]) == pytest.approx(row.expected, rel=1e-5)
        assert float(line[2]) == pytest.approx(row.got, rel=1e-5, abs=0.1 * row.tolerance)


def test_figures_of_the_page_are_there_and_small(page):
    shown = re.findall(r"!\[[^\]]+\]\((validation/[\w.]+)\)", page)
    assert len(shown) == len(set(shown)) >= 5
    there = {f"validation/{path.name}" for path in (ROOT / "docs" / "validation").iterdir()}
    assert set(shown) == there
    assert all((ROOT / "docs" / name).stat().st_size < 80_000 for name in shown)


def test_links_of_the_page_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page):
        assert target.startswith("https://") or (PAGE.parent / target).resolve().exists(), target
    headings = re.findall(r"^#+ (.+)$", page, re.MULTILINE)
    for anchor in re.findall(r"\]\(#([^)]+)\)", page):
        assert anchor in {report._anchor(heading) for heading in headings}


def test_page_is_linked_from_the_readme():
    assert "(docs/validation.md)" in (ROOT / "README.md").read_text()
    assert re.search(r"^validate:", (ROOT / "Makefile").read_text(), re.MULTILINE)
