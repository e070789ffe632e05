"""Messages: unit tests. Detect a message of two lines, one that a terminal would obey, or one that
has lost where it belongs to or what is allowed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_mi.errors import LONGEST, InputError, one_line, printable
from lidar_mi.progress import Terminal
from lidar_mi.tables import Table


@given(st.text(max_size=60) | st.builds(lambda t, n: t * n, st.text(max_size=9), st.just(5000)))
def test_any_message_is_one_printable_line(text):
    message = str(InputError(text))
    assert len(message) <= LONGEST and message.isprintable()
    assert one_line(message) == message


def test_a_long_message_keeps_its_ends():
    message = str(InputError(f"a.yaml: seed: {'9' * 5000} is not allowed; expected at most 3"))
    assert message.startswith("a.yaml: seed: 99")
    assert message.endswith("99 is not allowed; expected at most 3")


def test_a_shortened_message_is_not_shortened_again():
    message = one_line("0 " * 5000)
    assert "  " not in message and one_line(message) == message


@pytest.mark.parametrize("text", ["\x1b[31mred", "\x9b31m", "\u202eright to left", "\udc80"])
def test_control_characters_are_escaped(text, capsys):
    assert printable(text).isascii() and "\\" in printable(text)
    shown = Terminal(width=80)
    shown.print(text)
    shown.print(text, soft_wrap=True)
    from lidar_mi.cli.terminal import print_table

    print_table(Table(text, [(text, text)], heads=(text, text), note=text))
    out = capsys.readouterr().out
    assert text[0] not in out and out.count(printable(text)) >= 6


def test_letters_of_any_language_stay():
    text = "Höhe = 5 µm ± 0,1, 高さ"
    assert printable(text) == text and one_line(f" {text}\n") == text
