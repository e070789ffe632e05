"""Step the lidar from a flight simulation of your own.

The lidar is an object: at every step it is told the time and the place of the aircraft, and it
delivers the vortices in a slab of air ahead. Here the simulation is an aircraft that drifts to the
left with the wind; replace `place` by yours.

    python examples/own_simulation.py      # a minute
"""

import argparse

import lidar_mi as lm

PAIR = {"circulation": "300 m^2/s", "separation": "30 m", "width": "80 m", "height": "50 m"}


def place(t: float) -> lm.AircraftPose:
    """Where the aircraft of the simulation is at a time (s): m from the start of the path."""
    return lm.AircraftPose(x=75.0 * t, y=2.0 * t)


def main(slabs: int, samples: int) -> list:
    """Estimates of successive slabs, with the truth beside them."""
    experiment = lm.load_experiment(
        "wake_backscatter",
        wake={"file": None, "time": None, "vortex_pair": PAIR, "spacing": "1 m"},
        lidar={"pulse_duration": "10 ns"},
        detector={},
        render={"samples_per_beam": samples, "max_order": 1},
        retrieval={"methods": ["vortex_fit"]},
        encounter={"path": {"start": "200 m", "crossing_angle": "5 deg"}},
    )
    lidar, found = lm.VirtualLidar(experiment), []
    for t in (0.1 * number for number in range(slabs + 1)):
        estimate = lidar.step(t, place(t))
        if estimate.pair is not None and estimate.pair.success:
            quantity = estimate.pair.quantities["port_circulation"]
            true, _ = lidar.wake.vortices(estimate.x, estimate.time)
            found.append((quantity.value, quantity.stderr, true.circulation))
            print(
                f"{t:.1f} s, slab at {estimate.x:.0f} m: port circulation {quantity.value:.0f} "
                f"+- {quantity.stderr:.0f} m^2/s, true {true.circulation:.0f} m^2/s"
            )
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--slabs", type=int, default=10)
    parser.add_argument("--samples", type=int, default=64, help="of a beam")
    options = parser.parse_args()
    main(options.slabs, options.samples)
