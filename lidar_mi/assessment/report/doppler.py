"""The Doppler lidar's chapter of a report."""

from collections.abc import Mapping, Sequence

from lidar_mi.assessment.digits import fixed, three, with_error
from lidar_mi.assessment.figures.panels import Drawn
from lidar_mi.assessment.metrics.names import REFERENCE_ERRORS, bound_key, reference_key, ring_key
from lidar_mi.assessment.metrics.velocities import CENTRES, PEAK_READERS, READERS
from lidar_mi.assessment.report.page import Chapter, NumberTable, Tables
from lidar_mi.schema.doppler import Doppler, RingRetrieval


def doppler_chapter(
    doppler: Doppler, metrics: Mapping[str, float], drawn: Sequence[Drawn]
) -> Chapter:
    """Rings and line-of-sight winds of the Doppler lidar."""
    purpose = (
        "A Doppler lidar images its backscatter through an etalon onto a CCD; the wind along the "
        "line of sight follows from the radii of the rings."
    )
    modes = metrics.get("doppler.speckle_modes")
    speckle = f"speckle has {three(modes)} modes per pixel" if modes else "there is no speckle"
    light = (
        f"A pulse gives {three(metrics['doppler.photons'])} photons from {doppler.lidar.range:g} m "
        f"and {three(metrics['doppler.background_photons'])} of sunlight; {speckle}, read-out "
        f"{doppler.ccd.read_noise / doppler.ccd.multiplication_gain:.3g} photoelectrons of noise."
    )
    rings = (
        f"The line is {metrics['doppler.line_width'] / 1e9:.2f} GHz wide, the etalon's free "
        f"spectral range {metrics['doppler.free_spectral_range'] / 1e9:.2f} GHz, its finesse "
        f"{metrics['doppler.finesse']:.1f}: the unambiguous velocity range is "
        f"{metrics['doppler.velocity_range']:.0f} m/s. Without noise, the rendered images give "
        f"the true winds to {metrics['doppler.render.largest_error']:.2g} m/s."
    )
    errors = {cause: metrics.get(reference_key(cause), 0.0) for cause in REFERENCE_ERRORS}
    causes = ", ".join(f"{cause} {error:.2g} m/s" for cause, error in errors.items() if error)
    hidden = (
        f"Errors between the laser's frame and the echo, which no image shows: {causes}. Plates "
        f"and pupil cause less than 0.5 m/s with at least "
        f"{metrics.get('doppler.reference.scrambling_needed', 0.0):.1%} of the light scrambled."
    )
    numbers = Tables(
        heading="Accuracy of the line-of-sight winds",
        legend="Winds that each method retrieves from noisy images, or from averages of several "
        "(columns), over all speeds, with standard errors. "
        f"{_abbreviations(doppler.retrieval.methods)}The bound (Cramér-Rao) is the least standard "
        "deviation without bias; its row is not of a method.",
        tables=[
            _doppler_table(doppler.retrieval, centre, metrics)
            for centre in doppler.retrieval.centre
        ],
    )
    return Chapter(
        "The Doppler lidar", [purpose, light, rings, *([hidden] if causes else [])], drawn, numbers
    )


def _abbreviations(methods: Sequence[str]) -> str:
    """The meaning of the names of those methods that use the peaks of the innermost ring."""
    names = {"ca": "CA: circular averaging", "ml": "ML: midpoint lines"}
    used = [text for key, text in names.items() if any(m.partition("_")[0] == key for m in methods)]
    if not set(methods) & set(PEAK_READERS):
        return ""
    return "; ".join([*used, "peaks are those of the innermost ring, emitted and received"]) + ". "


def _doppler_table(
    settings: RingRetrieval, centre: str, metrics: Mapping[str, float]
) -> NumberTable:
    rows = []
    for method in settings.methods:
        for quantity, label in (("std", "standard deviation"), ("bias", "bias")):
            cells = []
            for n in settings.averaged:
                key = ring_key(method, centre, n, quantity)
                value, error = metrics.get(key), metrics.get(f"{key}_stderr")
                if value is None:
                    cells.append("-")
                else:
                    cells.append(fixed(value) if error is None else with_error(value, error))
            rows.append((f"{READERS[method]}: {label}", "m/s", cells))
    bounds = [fixed(metrics[bound_key(centre, n)]) for n in settings.averaged]
    rows.append(("bound", "m/s", bounds))
    heads = [f"{n} image{'s' * (n > 1)}" for n in settings.averaged]
    return CENTRES[centre], heads, rows
