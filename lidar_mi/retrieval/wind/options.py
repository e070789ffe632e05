"""Options of `retrieve_wind` and of its like for series and volumes."""

from dataclasses import dataclass

from lidar_mi.arguments import check_fields
from lidar_mi.retrieval.correlation.outliers import MEDIAN_EPSILON, MEDIAN_THRESHOLD
from lidar_mi.retrieval.images.windows import Windows


@dataclass(frozen=True)
class WindowSizes:
    """Sizes of the windows that displacements belong to, in pixels or voxels.

    Winds beyond ((search - template) // 2 - 1/2) spacing / dt are out of range: 17.5 m/s for 8 in
    16 at 0.5 m and 0.1 s.

    Attributes
    ----------
    template : int
        Side of a template, >= 2 in images, >= 4 in volumes.
    search : int
        Side of the search region around a template, >= template + 2.
    stride : int
        Step from one window to the next, >= 1.

    Raises
    ------
    InputError
        A size that is no whole number.
    """

    template: int = 8
    search: int = 16
    stride: int = 1

    def __post_init__(self) -> None:
        check_fields(self)

    def on(self, shape: tuple[int, ...]) -> Windows:
        """The windows of an image (z, y) or a volume (x, z, y)."""
        return Windows(shape, self.template, self.search, self.stride)


@dataclass(frozen=True)
class VectorValidation:
    """Tests of vectors: a vector that fails one is flagged and keeps its value.

    Attributes
    ----------
    min_correlation : float
        Least correlation of a window, -1 to 1 (not for "ws"). For "variational" the limit is half
        way from this value to 1.
    min_texture, min_isotropy : float
        For images. The rms gradient of a template of image 1 in its weakest direction, relative to
        the mean of the template, must be above min_texture (px^-1); its ratio to the rms gradient
        in the strongest direction must be at least min_isotropy. See `quality.texture`.
    median_size, median_threshold, median_epsilon
        Normalised median test, see `outliers.median_outliers`. Neighbours are taken half a template
        apart (or a stride, if that is more): closer ones share their pixels.

    Raises
    ------
    InputError
        A threshold that is no number.
    """

    min_correlation: float = 0.5
    min_texture: float = 0.01
    min_isotropy: float = 0.2
    median_size: int = 3
    median_threshold: float = MEDIAN_THRESHOLD
    median_epsilon: float = MEDIAN_EPSILON

    def __post_init__(self) -> None:
        check_fields(self)


IMAGE_WINDOWS, VOLUME_WINDOWS = WindowSizes(), WindowSizes(stride=4)
VALIDATION = VectorValidation()
