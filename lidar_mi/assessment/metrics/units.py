"""Units of metrics, by the quantity at the end of their names."""

import functools

_WIND = ("rms_", "rmse_", "bias", "p50_", "p90_", "std", "expected_", "monte_carlo_")
_NAMED = {
    "coherent.noise": "m/s",
    "coherent.cnr": "dB",
    "pointing.scan_time": "s",
    "pointing.rms_y": "m",
    "pointing.rms_z": "m",
    "pointing.rotation": "rad/s",
    "doppler.line_width": "Hz",
    "doppler.free_spectral_range": "Hz",
    "doppler.velocity_range": "m/s",
    "doppler.render.largest_error": "m/s",
    "doppler.reference.laser_drift": "m/s",
    "doppler.reference.etalon_drift": "m/s",
    "doppler.reference.bow_and_pupil": "m/s",
    "doppler.reference.wedge_and_pupil": "m/s",
}
_ENCOUNTER = {
    "largest_roll": "rad",
    "largest_roll_rate": "rad/s",
    "largest_lift": "N",
    "preview_from": "s",
    "lead_time": "s",
    "withdrawn": "s",
    "latency": "s",
    "latency_99": "s",
    "wind_latency": "s",
    "wind_latency_99": "s",
    "look_ahead": "s",
    "core_error": "m",
}


@functools.cache
def _of_vortices() -> dict[str, str]:
    from lidar_mi.retrieval.vortices.pair import MEANING

    parameters = {
        name: units.replace(" s-1", "/s").replace("m2", "m²")
        for name, (units, _) in MEANING.items()
    }
    return parameters | {"model_error": "m/s"}


def unit_of(key: str) -> str:
    """Unit of a metric as reports write it; empty for numbers without one."""
    if key in _NAMED:
        return _NAMED[key]
    *_, parent, name = ("", *key.split("."))
    if name.startswith(_WIND) and name != "monte_carlo_fraction":
        return "rad" if name.endswith("_direction") else "m/s"
    if key.startswith("encounter.") and not parent.startswith("removed_"):
        return _ENCOUNTER.get(name, "")
    if key.startswith("vortex."):
        return _of_vortices().get(name.removesuffix("_stderr"), "")
    if parent.endswith("_core"):
        return "m²/s" if name == "circulation" else "m"
    return {"timing": "s"}.get(parent, "")
