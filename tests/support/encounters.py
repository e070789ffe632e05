"""A small encounter: 41 x 31 beams, a pair of 300 m^2/s, 150 m ahead."""

import lidar_mi as lm


def small_encounter(seed=1, path=None, wake=None, render=None, control=None, **changes):
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
            "wake": {
                "file": None,
                "time": None,
                "vortex_pair": pair,
                "spacing": "1 m",
                "extinction": {"molecules": 0},
            }
            | (wake or {}),
            "lidar": {"pulse_duration": "10 ns"},
            "render": {"samples_per_beam": 32, "max_order": 1, "variant": "llvm_ad_mono"}
            | (render or {}),
            "retrieval": {"methods": ["vortex_fit"]},
            "encounter": {
                "path": {"start": "190 m", "crossing_angle": "0 deg", "climb_angle": "0 deg"}
                | (path or {}),
                # that of a machine would differ from run to run
                "control": control or {"latency": "0.12 s"},
            },
        }
        | changes,
    )


def both_lidars(seed=1, path=None, doppler=None, sensor=None, **changes):
    """The same with a Doppler lidar: 12 lines of sight, a camera of 240 x 195 px."""
    told = {
        "camera": {"width": 240, "height": 195, "pixel": "29.6 um"},
        "ccd": {"binning": 4},
        "reference": {"every": 240},
        "retrieval": {"methods": ["annular"], "averaged": [1]},
    }
    lines = {"columns": 4, "rows": 3, "azimuth_half": "7 deg", "elevation_half": "3.2 deg"}
    return small_encounter(
        seed,
        path,
        doppler=told | (doppler or {}),
        sensor={"directions": lines, "pulses": 20, "method": "variational"} | (sensor or {}),
        retrieval={"methods": ["variational"], "stride": 4},
        **changes,
    )
