"""Numbers as reports write them. Detects digits that say nothing, lost signs and powers of ten."""

import pytest

from lidar_mi.assessment.digits import fixed, in_row, percent, three, with_error

BLANK = "\N{NO-BREAK SPACE}"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.1224, "0.122"),
        (0.15, "0.150"),
        (-0.000715, "-0.001"),
        (-0.0003, "0.000"),
        (11.24, "11.2"),
        (3.9, "3.90"),
        (1940.3, "1940"),
        (0, "0"),
        (-31.02, "-31.0"),
    ],
)
def test_errors_in_a_column(value, text):
    assert fixed(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00444, "0.00444"),
        (83812.0, "83800"),
        (6.674e7, f"6.67{BLANK}×{BLANK}10⁷"),
        (150.0, "150"),
        (2.4e-9, f"2.4{BLANK}×{BLANK}10⁻⁹"),
        (0, "0"),
        (999999, f"1{BLANK}×{BLANK}10⁶"),
    ],
)
def test_three_digits(value, text):
    assert three(value) == text


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        (0.00432, "0.43"),
        (0.7212, "72"),
        (1, "100"),
        (0, "0"),
        (-0.77, "-77"),
        (0.0996, "10"),
        (0.000021, "0.0021"),
        (13.2, "1320"),
    ],
)
def test_fractions(fraction, text):
    assert percent(fraction) == f"{text} %"


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (0.6473, 0.1183, "0.65|0.12"),
        (-0.0285, 0.165, "-0.03|0.17"),
        (439.94, 9.04, "439.9|9.0"),
        (454.2, 10.3, "454|10"),
        (1.5, 0.0, "1.500|0.000"),
    ],
)
def test_values_with_errors(value, stderr, text):
    assert with_error(value, stderr) == text.replace("|", f"{BLANK}±{BLANK}")


def test_rows_show_fractions_in_per_cent_and_missing_values_as_a_dash():
    assert in_row([0.6827, None], "%") == ["68.3", "-"]
    assert in_row([0.1224, None, -0.0006], "m/s") == ["0.122", "-", "-0.001"]
