"""Meshes that are no cubes to Mitsuba."""

from pathlib import Path

CORNERS = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
# wound inwards
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def box_file(folder: Path) -> str:
    """Name of a PLY file of the cube of half edge 1, of 8 corners and 12 triangles."""
    triangles = [t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))]
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(CORNERS)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    lines = [*(" ".join(map(str, corner)) for corner in CORNERS)]
    lines += [" ".join(map(str, (3, *triangle))) for triangle in triangles]
    path = folder / "box.ply"
    path.write_text("\n".join(head + lines) + "\n")
    return str(path)
