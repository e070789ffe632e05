"""Sizes of windows that are possible, known before any image is."""

from lidar_mi.errors import InputError


def check_window_sizes(shape: tuple[int, ...], template: int, search: int, stride: int) -> None:
    """Refuse windows that are too small, or larger than an image or a volume.

    shape: (z, y) of an image, (x, z, y) of a volume, pixels.
    template, search, stride: pixels, see `lidar_mi.retrieval.images.windows.Windows`.

    Raises InputError: a size out of its range, an image smaller than the search region, a volume
    smaller than a template.
    """
    image = len(shape) == 2
    unit = "px" if image else "voxels"
    lowest = {"template": 2 if image else 4, "search": template + 2, "stride": 1}
    for (name, low), value in zip(lowest.items(), (template, search, stride), strict=True):
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            allowed = "template + 2" if name == "search" else low
            raise InputError(f"{name}: {value!r} {unit} is not an integer >= {allowed}")
    if min(shape) < (search if image else template):
        sizes = " x ".join(map(str, shape))
        raise InputError(
            f"search: {search} px does not fit into the image of {sizes} (z x y) px"
            if image
            else f"template: {template} voxels do not fit into the volume of {sizes} "
            "(x, z, y); expected at least as many voxels (gates along x) in every direction"
        )
