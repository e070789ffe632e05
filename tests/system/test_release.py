"""What a release consists of beside the package: image, citation, paper, workflows.

Detects a version, a dependency or a bound that one of them states otherwise than pyproject.toml, a
file that the container image would lack, and a paper that cites nothing it has.
"""

import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

import lidar_mi

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(
    not (ROOT / "CITATION.cff").is_file(), reason="a release is made from the source tree"
)


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_one_version(project):
    version = project["version"]
    assert lidar_mi.__version__ == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert f"`{version}`" in (ROOT / "docs" / "versions.md").read_text() or "rc" not in version


def test_image_has_what_a_wheel_is_made_of():
    text = (ROOT / "Dockerfile").read_text()
    allowed = (ROOT / ".dockerignore").read_text().splitlines()
    for name in ("pyproject.toml", "README.md", "LICENSE", "lidar_mi", "plugins", "scenes"):
        assert re.search(rf"^COPY .*\b{re.escape(name)}\b", text, re.MULTILINE)
        assert f"!{name}" in allowed
    assert text.startswith("#") and "FROM debian:bookworm-slim" in text


def test_commands_of_the_image_can_run(lidar_mi):
    """What is copied is there, what pip installs are requirements, what starts is a command."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line[:1].isalpha()]
    for word, rest in lines:
        if word == "COPY":
            *sources, _ = rest.split()
            assert all((ROOT / source).exists() for source in sources)
    (pip,) = (part for _, rest in lines for part in rest.split("&&") if "pip install" in part)
    words = shlex.split(pip.split("pip install")[1])
    *given, source = [word for word in words if not word.startswith(("-", "https:"))]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    allowed = {one.name: one.specifier for one in map(Requirement, project["dependencies"])}
    # a version that the package does not allow would be replaced
    for one in map(Requirement, given):
        assert set(one.specifier) <= set(allowed[one.name])
    assert source == "/source"
    (command,) = (json.loads(rest) for word, rest in lines if word == "ENTRYPOINT")
    environment = re.search(r"python3 -m venv (\S+)", text)[1]
    assert [name for name in project["scripts"] if f"{environment}/bin/{name}" == command[0]]
    (arguments,) = (json.loads(rest) for word, rest in lines if word == "CMD")
    assert lidar_mi(*arguments)[0] == 0


@pytest.mark.parametrize("name", sorted(p.name for p in (ROOT / ".github/workflows").glob("*.yml")))
def test_workflow_runs_commands_that_exist(name):
    """Every job has steps; targets of make are the Makefile's."""
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / name).read_text())
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for job in workflow["jobs"].values():
        commands = [step.get("run", "") for step in job["steps"]]
        made = [match for text in commands for match in re.findall(r"^make ([\w-]+)", text, re.M)]
        assert set(made) <= set(targets)


def test_publishing_needs_no_password():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    publish = workflow["jobs"]["publish"]
    assert publish["permissions"] == {"id-token": "write"} and publish["needs"] == "build"
    assert "secrets." not in (ROOT / ".github" / "workflows" / "release.yml").read_text()


def test_paper_cites_what_its_bibliography_has():
    text = (ROOT / "paper" / "paper.md").read_text()
    entries = re.findall(r"^@\w+\{(\w+),", (ROOT / "paper" / "paper.bib").read_text(), re.MULTILINE)
    assert set(re.findall(r"@(\w+)", text)) == set(entries)
    script = (ROOT / "paper" / "make_figures.py").read_text()
    for figure in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text):
        assert f'"{figure}"' in script
    words = len(re.sub(r"^---.*?^---", "", text, flags=re.DOTALL | re.MULTILINE).split())
    assert 500 < words < 1750  # as the journal asks
