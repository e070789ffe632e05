"""The short scripts to copy.

Detects a script that does not run by itself, is too long to copy, writes nothing, or is the same as
another.
"""

import re
from pathlib import Path

import matplotlib
import pytest
from matplotlib import pyplot as plt

PAGE = Path(__file__).parents[2] / "docs" / "scripts.md"
SCRIPTS = re.findall(r"^## ([^\n]+)\n\n```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S)


def test_twelve_are_short():
    assert len({title for title, _ in SCRIPTS}) == len({text for _, text in SCRIPTS}) == 12
    assert PAGE.read_text().count("```python") == 12
    for title, text in SCRIPTS:
        assert len(text.splitlines()) <= 15, title


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("text", [pytest.param(text, id=title) for title, text in SCRIPTS])
def test_each_runs_by_itself(text, tmp_path, monkeypatch, capsys):
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    try:
        exec(compile(text, str(PAGE), "exec"), {"__name__": "__main__"})
    finally:
        plt.close("all")
    files = [path for path in tmp_path.iterdir() if path.stat().st_size]
    assert capsys.readouterr().out or files
    promised = re.findall(r'(?:savefig|to_csv|to_netcdf)\("(.+?)"', text)
    assert {path.name for path in files} >= set(promised)
