"""A coherent lidar in the answer of a run, and in what was simulated."""

from collections.abc import Iterator, Mapping

from lidar_mi.assessment.digits import fixed, percent, whole_percent
from lidar_mi.assessment.metrics.coherent import PREFIX, PUBLISHED
from lidar_mi.schema.coherent import CoherentDoppler
from lidar_mi.schema.wake import Wake
from lidar_mi.units import shown

_SCANS = {
    "rhi": "vertical slices",
    "ppi": "cones",
    "dbs": "rounds of five beams",
    "stare": "lines in one direction",
}
_VORTICES = f"{PREFIX}vortices."
_WINDS = f"{PREFIX}winds."


def coherent_answer(metrics: Mapping[str, float]) -> Iterator[str]:
    """Sentences of the answer on what the lines of a coherent lidar tell."""
    valid = metrics.get(f"{_VORTICES}valid_fraction")
    if metrics.get(f"{PREFIX}signal_fraction", 1.0) == 0:
        yield "Coherent lidar: no signal in any gate, velocities are random."
    elif valid is not None:
        head = f"Coherent lidar, {metrics[f'{_VORTICES}scans']:.0f} vertical slices"
        if f"{_VORTICES}place_error" not in metrics:
            yield f"{head}: no valid vortex."
            return
        yield (
            f"{head}: median errors of the vortices' circulation "
            f"{percent(metrics[f'{_VORTICES}circulation_error'])}, of their place "
            f"{percent(metrics[f'{_VORTICES}place_error'])} of the separation (published: "
            f"{percent(PUBLISHED['circulation_error'])} and {percent(PUBLISHED['place_error'])}); "
            f"{whole_percent(valid)} of the slices are valid."
        )
        covered = [metrics[f"{_VORTICES}coverage_95_{name}"] for name in ("circulation", "y", "z")]
        yield (
            "95 % intervals of circulation, distance and height hold "
            f"{', '.join(whole_percent(fraction) for fraction in covered)} of the errors."
        )
    elif metrics.get(f"{_WINDS}valid_fraction") == 0:
        yield "Coherent lidar: no valid wind."
    elif f"{_WINDS}rmse_u" in metrics:
        errors = ", ".join(fixed(metrics[f"{_WINDS}rmse_{name}"]) for name in "uvw")
        yield (
            f"Coherent lidar: rms errors of the wind to the east, to the north and up {errors} "
            f"m/s; {whole_percent(metrics[f'{_WINDS}valid_fraction'])} of the winds are valid."
        )
    elif f"{PREFIX}noise" in metrics:
        yield (
            f"Coherent lidar: {metrics[f'{PREFIX}lines']:.0f} lines of sight, whose velocities "
            f"have a noise of {metrics[f'{PREFIX}noise']:.2g} m/s (median)."
        )


def coherent_lidar_rows(lidar: CoherentDoppler, wake: Wake | None) -> list[tuple[str, str]]:
    """What was simulated, as (name, text)."""
    laser, scan = lidar.laser, lidar.scan
    rows = []
    if wake is not None:
        wake_text = f"{wake.file}, a plane that drifts as it is"
        if wake.vortex_pair:
            pair = wake.vortex_pair
            wake_text = (
                f"{pair.model.replace('_', '-').title()} vortices, circulation "
                f"{pair.circulation:.4g} m²/s, separation {pair.separation:.4g} m, core radius "
                f"{pair.core_radius:.3g} m"
            )
        rows.append(("wake", f"{wake_text}; at a height of {lidar.passage.height:g} m"))
    where = ", ".join(f"{place:g}" for place in lidar.position)
    rows += [
        (
            "coherent lidar",
            f"{shown(laser.wavelength, 'nm')}, pulses of {laser.pulse_length:g} m, gates of "
            f"{laser.gate_length:g} m every {laser.gate_spacing:g} m from {laser.first_gate:g} m; "
            f"{lidar.signal.cnr:g} dB at {lidar.signal.range:g} m; at ({where}) m",
        ),
        ("scan", f"{scan.count} {_SCANS[scan.kind]}, {shown(scan.accumulation, 's')} a line"),
    ]
    return rows
