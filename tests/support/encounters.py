"""A small encounter: 41 x 31 beams, a pair of 300 m^2/s, 150 m ahead."""

import lidar_mi as lm


def small_encounter(seed=1, path=None, wake=None, render=None, **changes):
    """An encounter that a step of takes some tenths of a second."""
    pair = {
        "circulation": "300 m^2/s",
        "separation": "24 m",
        "core_radius": "3 m",
        "width": "60 m",
        "height": "40 m",
    }
    return lm.load_experiment(
        "wake_backscatter",
        **{
            "seed": seed,
            "wake": {"file": None, "time": None, "vortex_pair": pair, "spacing": "1 m"}
            | (wake or {}),
            "lidar": {"pulse_duration": "10 ns"},
            "render": {"samples_per_beam": 32, "max_order": 1, "variant": "llvm_ad_mono"}
            | (render or {}),
            "retrieval": {"methods": ["vortex_fit"]},
            "encounter": {
                "path": {"start": "190 m", "crossing_angle": "0 deg", "climb_angle": "0 deg"}
                | (path or {})
            },
        }
        | changes,
    )
