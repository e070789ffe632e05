"""Write the table of docs/guide/jsbsim.md: which aircraft of JSBSim fly, and why others do not.

Usage: ``python docs/make_jsbsim.py``, about two minutes.
"""

import re
from importlib.metadata import version
from pathlib import Path

import jsbsim

from lidar_mi.aircraft.jsbsim_aircraft import JSBSimAircraft
from lidar_mi.errors import InputError
from lidar_mi.io.jsbsim_files import shipped_aircraft
from lidar_mi.schema import encounter

PAGE = Path(__file__).parent / "guide" / "jsbsim.md"
BEGIN, END = "<!-- aircraft: begin -->", "<!-- aircraft: end -->"
HEAD = "| aircraft | trims at, m/s | reason of refusal, or JSBSim's message |\n| --- | --- | --- |"
OTHER_SPEED = re.compile(r"another speed, such as (\S+) m/s$")
REASONS = (
    re.compile(r"is not allowed: it has (.*); expected"),
    re.compile(r"JSBSim does not fly '.*?' \((.*)\); expected"),
    re.compile(r"\(it (trims at none of .*), at which"),
)


def row(name: str) -> str:
    """One line of the table: the default path, or the speed that the refusal of it names."""
    path = encounter.Path()
    while True:
        try:
            JSBSimAircraft(encounter.Aircraft(model=name), path)
        except InputError as error:
            other = OTHER_SPEED.search(str(error))
            if not other:
                return f"| `{name}` | - | {_reason(str(error))} |"
            path = path.model_copy(update={"speed": float(other[1])})
        else:
            return f"| `{name}` | {path.speed:g} | |"


def names() -> tuple[str, ...]:
    """Of all aircraft that JSBSim ships."""
    return shipped_aircraft(Path(jsbsim.__file__).parent)


def main() -> None:
    """Replace the table between the two marks."""
    text = PAGE.read_text()
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    table = "\n".join([f"JSBSim {version('jsbsim')}:", "", HEAD, *map(row, names())])
    PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}")


def _reason(message: str) -> str:
    return next(found[1] for one in REASONS if (found := one.search(message)))


if __name__ == "__main__":
    main()
