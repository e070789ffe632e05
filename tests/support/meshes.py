"""Meshes that are no cubes to Mitsuba."""

from pathlib import Path

CORNERS = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
# wound inwards
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def box_file(folder: Path, cavity: float = 0) -> str:
    """Name of a PLY file of the cube of half edge 1, of 8 corners and 12 triangles.

    With a ``cavity``, the half edge of a second one within it, which is wound the other way round.
    """
    triangles = [t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))]
    corners = CORNERS
    if cavity:
        corners = CORNERS + [tuple(cavity * x for x in corner) for corner in CORNERS]
        triangles += [(c + 8, b + 8, a + 8) for a, b, c in triangles]
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(corners)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    lines = [*(" ".join(map(str, corner)) for corner in corners)]
    lines += [" ".join(map(str, (3, *triangle))) for triangle in triangles]
    path = folder / "box.ply"
    path.write_text("\n".join(head + lines) + "\n")
    return str(path)
