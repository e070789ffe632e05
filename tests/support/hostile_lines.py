"""Hypothesis strategies for files of lines of sight, damaged in every format."""

from functools import cache

from hypothesis import strategies as st

from tests.support import line_files as made
from tests.support.cases import Case
from tests.support.hostile_files import stored
from tests.support.hostile_values import damaged


@cache
def _whole() -> dict[str, bytes]:
    """A small file of every kind, by its name."""
    known = made.lines(4, 6)
    return {
        "a.hpl": made.halo_text(known).encode(),
        "a.csv": made.csv_text(known).replace("v_r", "radial_velocity").encode(),
        "a.cdf": stored(lambda path: made.write_arm(path, known), ".cdf"),
        "w.nc": stored(lambda path: made.write_windcube(path, known), ".nc"),
        "c.nc": stored(lambda path: made.write_cfradial1(path, known, sweeps=2), ".nc"),
        "r.nc": stored(lambda path: made.write_cfradial1(path, known, ragged=True), ".nc"),
        "d.nc": stored(lambda path: made.write_cfradial2(path, known), ".nc"),
    }


@st.composite
def line_cases(draw: st.DrawFn) -> Case:
    """A damaged file that is described, or from which winds are retrieved."""
    name = draw(st.sampled_from(sorted(_whole())))
    files = {name: draw(damaged(_whole()[name]))}
    call = draw(st.sampled_from((("info", name), ("winds", name, "-o", "o.nc"))))
    return Case("lines", call, files, ("o.nc", "o.png"))
