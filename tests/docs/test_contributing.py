"""The guide for contributors. Detects files and make targets that it names and do not exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GUIDE = ROOT / "CONTRIBUTING.md"

pytestmark = pytest.mark.skipif(not GUIDE.is_file(), reason="a page of the source tree")


def test_named_files_exist():
    quoted = re.findall(r"`([^`\n]+)`", GUIDE.read_text(encoding="utf-8"))
    paths = [q for q in quoted if re.fullmatch(r"[\w./]+(/|\.(py|md|yml|yaml|toml))", q)]
    paths = [path for path in paths if "NAME" not in path]
    assert len(paths) > 25
    assert not [path for path in paths if not (ROOT / path).exists()]


def test_make_targets_exist():
    named = set(re.findall(r"\bmake ([a-z-]+)", GUIDE.read_text(encoding="utf-8")))
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    assert {"test", "lint"} < named <= targets
