"""Requirement tables and verdicts.

Detects a number that differs from the published table, a verdict or margin on the wrong side of a
limit, a row that passes without a measurement, and input that would be taken for something else.
Everything is exact.
"""

import math

import pytest

from lidar_mi.assessment.metrics.requirements import (
    PAPER,
    QUANTITIES,
    Requirement,
    RequirementTable,
    as_rows,
    fulfilled,
    judge,
    look_ahead,
    read_requirements,
)
from lidar_mi.errors import InputError

TABLES = read_requirements()


def limits(application, phase):
    return {row.quantity: row for row in TABLES[application, phase].rows}


def test_the_published_table():
    """Both columns at landing and, in brackets, at cruise."""
    assert set(TABLES) == {
        (a, p) for a in ("disturbance", "flight_control") for p in ("landing", "cruise")
    }
    for phase, reach, depth in (("landing", 150, 4.5), ("cruise", 500, 15)):
        rows = limits("disturbance", phase)
        assert set(rows) == set(
            ("range points_per_slab slabs_per_second slab_depth error_v_los").split()
        )
        assert rows["range"].minimum == reach
        assert rows["points_per_slab"].minimum == 63
        assert rows["slabs_per_second"].minimum == 10
        assert rows["slab_depth"].fraction_of_range * reach == pytest.approx(depth)
        assert rows["error_v_los"].maximum == 0.5
    for phase, reach, depth in (("landing", (30, 150), (3, 15)), ("cruise", (120, 600), (12, 60))):
        rows = limits("flight_control", phase)
        assert (rows["range"].minimum, rows["range"].maximum) == reach
        assert rows["points_per_slab"].minimum == 20
        assert rows["slabs_per_second"].minimum == 10
        assert tuple(rows["slab_depth"].fraction_of_range * r for r in reach) == pytest.approx(
            depth
        )
        assert [rows[f"error_{c}"].maximum for c in "uvw"] == [2.5] * 3


def test_a_phase_of_flight_has_its_speeds():
    """250 knots, 128.6 m/s, part landing and cruise; a table without speeds applies at any."""
    for application in ("disturbance", "flight_control"):
        landing, cruise = TABLES[application, "landing"], TABLES[application, "cruise"]
        assert landing.applies_at(70) and not cruise.applies_at(70)
        assert cruise.applies_at(240) and not landing.applies_at(240)
        assert landing.fastest == cruise.slowest == pytest.approx(250 * 1852 / 3600)
    assert RequirementTable("a", "a", "any", ()).applies_at(0)


GOOD = {
    "range": 76.0,
    "points_per_slab": 63,
    "slabs_per_second": 10.0,
    "slab_depth": 7.0,
    "error_u": 1.0,
    "error_v": 2.0,
    "error_w": 2.5,
}


def test_a_sensor_that_complies_and_its_margins():
    findings = judge(TABLES["flight_control", "landing"], GOOD | {"error_v_los": 0.6})
    assert fulfilled(findings) is True
    margins = {f.quantity: f.margin for f in findings}
    assert margins == pytest.approx(
        {
            "range": 1 - 76 / 150,
            "points_per_slab": 43 / 20,
            "slabs_per_second": 0.0,
            "slab_depth": 0.6 / 7.6,
            "error_u": 0.6,
            "error_v": 0.2,
            "error_w": 0.0,
        }
    )


@pytest.mark.parametrize(
    ("changed", "margin"),
    [
        ({"range": 160.0}, -10 / 150),
        ({"range": 20.0}, -1 / 3),
        ({"points_per_slab": 19}, -0.05),
        ({"slabs_per_second": 5.0}, -0.5),
        ({"slab_depth": 10.0}, -2.4 / 7.6),
        ({"error_w": 5.0}, -1.0),
    ],
)
def test_each_row_can_fail(changed, margin):
    findings = judge(TABLES["flight_control", "landing"], GOOD | changed)
    name = next(iter(changed))
    found = next(f for f in findings if f.quantity == name)
    assert found.passed is False and fulfilled(findings) is False
    assert found.margin == pytest.approx(margin)


def test_unknown_values_do_not_pass():
    for missing in (math.nan, None):
        findings = judge(TABLES["flight_control", "landing"], GOOD | {"error_v": missing})
        row = next(f for f in findings if f.quantity == "error_v")
        assert row.passed is None and math.isnan(row.margin) and fulfilled(findings) is None
    # without a range its share is not known either, and a failure elsewhere still is one
    without = {k: v for k, v in GOOD.items() if k != "range"}
    findings = judge(TABLES["flight_control", "landing"], without)
    assert {f.quantity for f in findings if f.passed is None} == {"range", "slab_depth"}
    assert (
        fulfilled(judge(TABLES["flight_control", "landing"], without | {"error_u": 9.0})) is False
    )
    nothing = judge(TABLES["flight_control", "landing"], {})
    assert all(f.passed is None for f in nothing)


def test_a_fraction_of_the_range_and_a_fixed_limit():
    table = RequirementTable(
        "a", "a", "p", (Requirement("slab_depth", maximum=5.0, fraction_of_range=0.1),)
    )
    for reach, maximum in ((30.0, 3.0), (100.0, 5.0)):
        (found,) = judge(table, {"range": reach, "slab_depth": 4.0})
        assert found.maximum == maximum and found.passed is (4.0 <= maximum)


def test_look_ahead():
    assert look_ahead(75.0, 150.0) == 0.5
    assert math.isinf(look_ahead(75.0, 0.0))
    with pytest.raises(InputError, match="speed: -1 m/s is not allowed"):
        look_ahead(75.0, -1)


def test_as_rows():
    table = TABLES["flight_control", "landing"]
    findings = judge(table, GOOD | {"error_w": 3.0, "error_v": None})
    rows = {row[0]: row[1:] for row in as_rows(findings)}
    assert rows["range"] == ("30 to 150 m", "76 m", "+49 %", "pass")
    assert rows["points per slab"] == ("at least 20", "63", "+215 %", "pass")
    assert rows["slab depth"] == ("at most 7.6 m", "7 m", "+8 %", "pass")
    assert rows["error of v"] == ("at most 2.5 m/s", "", "", "not judged: not measured")
    assert rows["error of w"] == ("at most 2.5 m/s", "3 m/s", "-20 %", "fail")


def test_a_table_of_ones_own(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("glider:\n  soaring:\n    range: {min: 0.1 km}\n    error_w: {max: 50 cm/s}\n")
    (table,) = read_requirements(file).values()
    assert table == RequirementTable(
        "glider",
        "glider",
        "soaring",
        (Requirement("range", minimum=100.0), Requirement("error_w", maximum=0.5)),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a:\n  b:\n    error_x: {max: 1 m/s}", "a.b.error_x: unknown row; did you mean error_"),
        ("a:\n  b:\n    colour: {max: 1 m/s}", "a.b.colour: unknown row (allowed: range, "),
        ("a:\n  b:\n    range: {most: 1 m}", "a.b.range.most: unknown limit (allowed: min, max, "),
        ("a:\n  b:\n    range: {min: 1 s}", "a.b.range.min: '1 s' is not allowed; expected a "),
        ("a:\n  b:\n    range: {min: -1 m}", "a.b.range.min: '-1 m' is not allowed"),
        ("a:\n  b:\n    range: {min: 9 m, max: 1 m}", "a.b.range: min above max"),
        ("a:\n  b:\n    error_u: {max_of_range: 1}", "a.b.error_u.max_of_range: not allowed"),
        ("a:\n  b:\n    range: 5 m", "a.b.range: '5 m' is not allowed; expected a section"),
        ("", "None is not allowed; expected a section"),
        ("a: [", "not valid YAML"),
    ],
)
def test_bad_tables_are_named(tmp_path, text, message):
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        read_requirements(file)
    assert str(error.value).startswith(f"{file}: ") and "\n" not in str(error.value)
    assert message in str(error.value)


def test_bad_measurements_are_named():
    for measured, message in (
        ({"error_q": 1.0}, "measured.error_q: unknown row"),
        ({"range": -1.0}, "measured.range: -1.0 m is not allowed"),
        ({"error_u": math.inf}, "measured.error_u: inf m/s is not allowed"),
    ):
        with pytest.raises(InputError) as error:
            judge(TABLES["flight_control", "landing"], measured)
        assert str(error.value).startswith(message)
    with pytest.raises(InputError, match=r"absent.yaml: No such file"):
        read_requirements("absent.yaml")


def test_the_shipped_file_names_every_row():
    """Its head lists the rows, so that a table can be written without reading code."""
    text = PAPER.read_text()
    rows = text.partition("# Rows: ")[2].partition(".\n")[0].replace("\n#", "")
    assert [name.strip() for name in rows.split(",")] == list(QUANTITIES)
