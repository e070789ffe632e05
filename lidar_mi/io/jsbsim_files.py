"""Aircraft of JSBSim: the files that it ships, and copies on which a wake acts."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

AXES = ("x", "y", "z")


def shipped_aircraft(root: Path) -> tuple[str, ...]:
    """Names of the aircraft below a folder of JSBSim's, in alphabetical order.

    It has the folders ``aircraft``, ``engine`` and ``systems``.
    """
    files = root.glob("aircraft/*/*.xml")
    return tuple(sorted(path.stem for path in files if path.stem == path.parent.name))


def write_aircraft_in_wake(root: Path, name: str, folder: Path) -> None:
    """Copy an aircraft to ``folder/name`` and let forces and moments of the body frame act on it.

    They are the properties ``external_reactions/wake-force-AXIS/magnitude`` (lbf) and
    ``external_reactions/wake-moment-AXIS/magnitude-lbsft``, in JSBSim's axes: x forward, y to
    starboard, z down. Sockets and files that the original opens are omitted. The root is that of
    `shipped_aircraft`; the folder exists.
    """
    shutil.copytree(root / "aircraft" / name, folder / name)
    path = folder / name / f"{name}.xml"
    tree = ElementTree.parse(path)
    top = tree.getroot()
    for tag in ("input", "output"):
        for element in top.findall(tag):
            top.remove(element)
    reactions = top.find("external_reactions")
    if reactions is None:
        reactions = ElementTree.SubElement(top, "external_reactions")
    for kind in ("force", "moment"):
        for axis in AXES:
            node = ElementTree.SubElement(reactions, kind, name=f"wake-{kind}-{axis}", frame="BODY")
            if kind == "force":
                _vector(node, "location", "000", unit="IN")
            _vector(node, "direction", ["1" if axis == a else "0" for a in AXES])
    tree.write(path)


def _vector(
    parent: ElementTree.Element, tag: str, values: Sequence[str], **attributes: str
) -> None:
    element = ElementTree.SubElement(parent, tag, attributes)
    for axis, value in zip(AXES, values, strict=True):
        ElementTree.SubElement(element, axis).text = value
