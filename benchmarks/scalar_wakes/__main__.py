"""Sixty image pairs of wakes, and what programs make of them.

python -m benchmarks.scalar_wakes make FOLDER          # renders them: minutes
python -m benchmarks.scalar_wakes score FOLDER MINE    # MINE/PAIR.flo or MINE/PAIR.nc for each pair
python -m benchmarks.scalar_wakes table FOLDER         # our methods, OpenPIV and DIS, if installed

``table --write`` writes the table into docs/scalar_wakes.md.
"""

import argparse
from pathlib import Path

import numpy as np
import xarray as xr

from .cases import CASES, names
from .make import make
from .programs import PROGRAMS
from .score import Score, errors_of, read_vectors, score

PAGE = Path(__file__).parents[2] / "docs" / "scalar_wakes.md"
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"

HEAD = (
    "| kind | program | rms error, m/s | valid | within 1 / 1.96 | variance |\n"
    "| --- | --- | --- | --- | --- | --- |"
)


def pairs(folder: Path):
    """Kind, name, images and truth of every pair that is there."""
    for case, _, name in names():
        if (folder / name / "truth.flo").exists():
            with (
                xr.open_dataset(folder / name / "images.nc") as images,
                xr.open_dataset(folder / name / "truth.nc") as truth,
            ):
                yield case.kind, name, images.load().astype(float), truth.load()


def row(kind: str, program: str, result: Score) -> str:
    """A line of the table; a dash where no error is stated."""
    stated = np.isfinite(result.variance)
    within = " / ".join(f"{100 * part:.0f}" for part in result.coverage) + " %" if stated else "-"
    variance = f"{result.variance:.2f}" if stated else "-"
    rms = f"{result.rms:.2f}" if np.isfinite(result.rms) else "-"
    cells = [kind, program, rms, f"{100 * result.valid:.0f} %", within, variance]
    return f"| {' | '.join(cells)} |"


def table(found: dict[str, dict[str, list]]) -> str:
    """By kind and program, and of all pairs."""
    kinds = [
        k for k in dict.fromkeys(case.kind for case in CASES) if k in next(iter(found.values()))
    ]
    lines = [
        row(kind, program, score(parts[kind])) for kind in kinds for program, parts in found.items()
    ]
    lines += [
        row("*all*", program, score([one for part in parts.values() for one in part]))
        for program, parts in found.items()
    ]
    return "\n".join([HEAD, *lines])


def run_programs(folder: Path) -> dict[str, dict[str, list]]:
    """Errors of every program on every pair."""
    found: dict[str, dict[str, list]] = {name: {} for name in PROGRAMS}
    for kind, _, images, truth in pairs(folder):
        for axis in ("z", "y"):
            images[axis].attrs["units"] = "m"
        for program, find in PROGRAMS.items():
            vectors = find(images["a"], images["b"], truth.attrs["dt"])
            found[program].setdefault(kind, []).append(errors_of(vectors, truth))
    return found


def read_programs(folder: Path, mine: Path) -> dict[str, dict[str, list]]:
    """Errors of vectors in files."""
    parts: dict[str, list] = {}
    for kind, name, _, truth in pairs(folder):
        files = [mine / f"{name}{suffix}" for suffix in (".nc", ".flo")]
        file = next((one for one in files if one.exists()), None)
        if file is None:
            raise SystemExit(f"{mine}: no {name}.nc nor {name}.flo")
        parts.setdefault(kind, []).append(errors_of(read_vectors(file, truth), truth))
    return {mine.name: parts}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scalar_wakes")
    parser.add_argument("what", choices=("make", "score", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("mine", type=Path, nargs="?")
    parser.add_argument("--only", default="", help="make pairs whose names begin so")
    parser.add_argument("--write", action="store_true", help="write the table into its page")
    options = parser.parse_args()
    if options.what == "make":
        make(options.folder, options.only)
    elif options.what == "score":
        if options.mine is None:
            parser.error("score: expected a folder of vectors")
        print(table(read_programs(options.folder, options.mine)))
    else:
        found = table(run_programs(options.folder))
        print(found)
        if options.write:
            before, _, rest = PAGE.read_text().partition(BEGIN)
            PAGE.write_text(f"{before}{BEGIN}\n\n{found}\n\n{END}{rest.partition(END)[2]}")
