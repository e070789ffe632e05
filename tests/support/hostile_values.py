"""Hypothesis strategies for values that nobody expects, and for bytes that are damaged."""

import math

from hypothesis import strategies as st

ESCAPES = ("\x1b[31mred", "\x1b]0;title\x07", "two\nlines", "\x00", "\u202e", "\x9b2J", "\udc80")

TEXTS = st.sampled_from(
    (
        *ESCAPES[:-1],
        "",
        " ",
        "x" * 5000,
        "../../etc/passwd",
        "/dev/zero",
        "a/b",
        ".",
        "~",
        "none",
        "null",
        "$HOME",
        "<b>",
        "{}",
        "[1, 2",
        "{{ 1 }}",
        "%s%n",
        "é" * 200,
    )
)

UNITS = st.sampled_from(
    (
        "m",
        "s",
        "m/s",
        "rad",
        "1",
        "",
        "%",
        "9**9**9 m",
        "m**99999999",
        "km h-1",
        "degC",
        "furlong/fortnight",
        "m" * 3000,
        "\x1b[31m",
        "__import__('os')",
        "1/0",
    )
)

NUMBERS = st.sampled_from(
    (0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 1e-320, 1e-30, 1e30, 1e308, -1e308, math.nan, math.inf)
) | st.floats(allow_nan=False, allow_infinity=False)

WHOLE = st.sampled_from(
    (0, 1, -1, 2, 3, 255, 256, 65_536, 2**31 - 1, 2**31, 2**63, -(2**63), 10**30, 10**400)
) | st.integers(-20, 2000)

ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    NUMBERS,
    WHOLE,
    TEXTS,
    st.builds(lambda number, unit: f"{number!r} {unit}", NUMBERS, UNITS),
    st.just([]),
    st.just({}),
    st.lists(NUMBERS | WHOLE | TEXTS, max_size=4),
    st.dictionaries(TEXTS, NUMBERS | TEXTS, max_size=2),
)
"""Any value that YAML can hold."""


@st.composite
def damaged(draw: st.DrawFn, content: bytes, most: int = 6) -> bytes:
    """Bytes, some of them changed, taken out, doubled or cut off; more often near the beginning."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, most))):
        if not data:
            break
        end = draw(st.sampled_from((64, 512, 4096, len(data))))
        place = draw(st.integers(0, min(end, len(data)) - 1))
        action = draw(st.sampled_from(("set", "set", "set", "word", "cut", "out", "twice", "text")))
        length = draw(st.integers(1, 64))
        if action == "set":
            data[place] = draw(st.sampled_from((0, 1, 0x7F, 0x80, 0xFF)) | st.integers(0, 255))
        elif action == "word":
            word = draw(st.sampled_from((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 30_000)))
            data[place : place + 4] = word.to_bytes(4, draw(st.sampled_from(("little", "big"))))
        elif action == "cut":
            del data[place:]
        elif action == "out":
            del data[place : place + length]
        elif action == "twice":
            data[place:place] = data[place : place + length]
        else:
            data[place:place] = draw(TEXTS).encode(errors="surrogatepass")
    return bytes(data)
