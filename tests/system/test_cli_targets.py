"""Commands that write a file: over their own results, not over anything else.

Detects an input that is replaced by the result, a file of someone else that is lost, and a second
run of the same command that is refused.
"""

import numpy as np
import pytest
from PIL import Image

from tests.support.command_line import files_in


@pytest.fixture
def images(there):
    """Two images of the same air, 1 m a pixel, 2 m apart."""
    air = np.random.default_rng(1).integers(0, 255, (40, 48), dtype=np.uint8)
    for name, shift in (("a.png", 0), ("b.png", 2)):
        Image.fromarray(np.roll(air, shift, 1)).save(there / name)
    return there


RETRIEVE = ("retrieve", "a.png", "b.png", "--dt", "1", "--spacing", "1", "--stride", "4")


def test_a_result_of_ours_is_replaced(images, lidar_mi):
    assert lidar_mi(*RETRIEVE, "-o", "w.nc")[0] == 1
    before = (images / "w.nc").stat().st_ino
    assert lidar_mi(*RETRIEVE, "-o", "w.nc")[0] == 1
    assert (images / "w.nc").stat().st_ino != before


def test_a_table_of_ours_is_replaced_on_request(images, lidar_mi):
    """A table has no place for the name of its program: the message says what to do."""
    assert lidar_mi(*RETRIEVE, "-o", "two.csv")[0] == 1
    code, _, err = lidar_mi(*RETRIEVE, "-o", "two.csv")
    assert code == 2 and "(tables do not); expected --overwrite to replace it" in " ".join(
        err.split()
    )
    assert lidar_mi(*RETRIEVE, "-o", "two.csv", "--overwrite")[0] == 1


@pytest.mark.parametrize(
    ("command", "target"),
    [
        (RETRIEVE, "a.png"),
        (RETRIEVE, "./b.png"),
        (("render", "slab.xml", "-s", "2"), "slab.xml"),
        (("render", "slab.xml", "-s", "2", "-D", "table=notes.txt"), "notes.txt"),
        (("rings", "a.png"), "a.png"),
    ],
)
def test_an_input_is_never_replaced(images, lidar_mi, command, target):
    (images / "notes.txt").write_text("mine")
    before = (images / target).read_bytes()
    code, _, err = lidar_mi(*command, "-o", target, "--overwrite")
    assert code == 2 and f"{target.removeprefix('./')}: is an input; expected" in err
    assert (images / target).read_bytes() == before


@pytest.mark.parametrize(
    "command",
    [RETRIEVE, ("render", "slab.xml", "-s", "2"), ("rings", "a.png"), ("aerosol", "soot")],
)
@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("notes.txt", "exists, and does not say that lidar-mi wrote it"),
        ("/dev/null", "is no ordinary file"),
    ],
)
def test_foreign_files_are_kept(images, lidar_mi, command, target, says):
    (images / "notes.txt").write_text("mine")
    code, _, err = lidar_mi(*command, "-o", target)
    assert code == 2 and f"{target}: {says}" in err
    assert (images / "notes.txt").read_text() == "mine"


def test_overwriting_needs_its_option(images, lidar_mi):
    (images / "notes.nc").write_text("mine")
    assert lidar_mi(*RETRIEVE, "-o", "notes.nc")[0] == 2
    assert (images / "notes.nc").read_text() == "mine"
    assert lidar_mi(*RETRIEVE, "-o", "notes.nc", "--overwrite")[0] == 1
    assert (images / "notes.nc").read_bytes().startswith(b"\x89HDF")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (RETRIEVE, ".nc, .csv, .mat, .vtk, .vti or .flo"),
        ((*RETRIEVE, "--pairs", "all"), ".nc, .csv or .mat"),
        (("render", "slab.xml", "-s", "2"), ".exr or .png"),
        (("rings", "a.png"), ".png"),
        (("rings", "a.png", "--all"), "a name that ends in .csv"),
        (("calibrate", "a.png"), ".nc"),
        (("v_los", "a.png"), ".nc"),
        (("aerosol", "soot"), ".txt"),
    ],
)
def test_a_name_of_another_format_is_refused(images, lidar_mi, command, expected):
    """One line, said before the work, and nothing is written under a name that says otherwise."""
    before = files_in(images)
    code, _, err = lidar_mi(*command, "-o", "out.dat")
    assert code == 2 and err.count("\n") == 1 and f"expected {expected}" in err
    assert files_in(images) == before


def test_a_run_never_replaces_its_input(there, lidar_mi, quick):
    """The record of a run is an experiment file, too."""
    assert lidar_mi("run", "tiny.yaml", "-o", "run")[0] == 0
    again = ("run", "run/experiment.yaml", "-o", "run")
    assert lidar_mi(*again)[0] == 0
    record = (there / "run" / "experiment.yaml").read_bytes()
    code, _, err = lidar_mi(*again, "--set", "seed=2", "--overwrite")
    assert code == 2 and "holds the experiment that this one was made from" in err
    assert (there / "run" / "experiment.yaml").read_bytes() == record


@pytest.mark.parametrize(
    ("target", "says"),
    [("x" * 300, "File name too long"), ("notes.txt/w.nc", "notes.txt is no folder")],
)
@pytest.mark.parametrize("command", [RETRIEVE, ("run", "tiny.yaml")])
def test_places_that_cannot_be(images, lidar_mi, command, target, says):
    """One line, said before the work, and nothing left."""
    (images / "notes.txt").write_text("mine")
    before = files_in(images)
    code, _, err = lidar_mi(*command, "-o", target)
    assert code == 2 and "Traceback" not in err
    if command[0] == "retrieve":
        assert says in err.splitlines()[-1]
    assert files_in(images) == before
