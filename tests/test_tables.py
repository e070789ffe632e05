"""Tables that results show. Unit tier.

Detects: digits that promise more or less than the standard error allows, columns that do not line
up, text of a user's that becomes HTML.
"""

import io
import math

import pytest

from lidar_mi.cli.terminal import print_table
from lidar_mi.progress import Terminal
from lidar_mi.tables import Table, as_html, as_text, with_error


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        ((312.44, 5.06, "m²/s"), "312.4 ± 5.1 m²/s"),
        ((312.44, 51.0), "312 ± 51"),
        ((-0.00123, 0.00045, "m/s"), "-0.00123 ± 0.00045 m/s"),
        ((1234567.0, 5000.0), "1234567 ± 5000"),
        ((3.14159, math.nan, "m"), "3.142 m"),
        ((3.14159, 0.0), "3.142"),
        ((math.nan, 1.0, "m"), "- m"),
    ],
)
def test_digits_follow_the_standard_error(arguments, shown):
    assert with_error(*arguments) == shown


TABLES = (
    Table("fruit <b>", (("apple & pear", "1.5"), ("fig", "10")), ("name", "kg")),
    Table("plain", (("a", "left"), ("bc", "x"))),
)


def test_columns_line_up():
    assert as_text(TABLES).splitlines() == [
        "fruit <b>",
        "  name           kg",
        "  apple & pear  1.5",
        "  fig            10",
        "plain",
        "  a   left",
        "  bc  x",
    ]


def test_text_is_no_html():
    page = as_html(TABLES, b"\x89PNG")
    assert "<caption>fruit &lt;b&gt;</caption>" in page and "<td>apple &amp; pear</td>" in page
    assert page.count("<table>") == 2 and 'src="data:image/png;base64,iVBORw=="' in page


def test_words_of_wide_tables_are_not_cut(monkeypatch):
    """Nine columns as of winds in three dimensions, on a terminal of 80 columns."""
    shown = Terminal(width=80, file=io.StringIO())
    monkeypatch.setattr("lidar_mi.cli.terminal.output", shown)
    heads = ("winds from", "method", *"uvw", "far u", "far v", "far w", "valid")
    print_table(Table("title", [("backscatter", "variational", *["0.08"] * 6, "100%")], heads))
    text = shown.file.getvalue()
    assert "backscatter" in text and "variational" in text
    assert max(map(len, text.splitlines())) <= 80
