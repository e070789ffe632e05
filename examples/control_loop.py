"""Close a control loop with the lidar of recorded flights, without a renderer.

A controller levels the wings of the default aircraft and cancels the roll gust that the lidar
announces. The variance of roll follows from a Lyapunov equation; with --flights the same loop flies
along the recorded flights, by their estimates as they were delivered and the true wind.

    lidar-mi fly gust --mode feedforward -o outputs/air --set encounter.path.beyond='900 m'
    lidar-mi export outputs/air --format control
    python examples/control_loop.py outputs/air/control/block_151m.npz --flights outputs/air
"""

import argparse
from pathlib import Path

import control as ct
import numpy as np
import scipy

INERTIA, AILERON_MOMENT = 8.0e5, 1.052e6  # kg m^2 and N m/rad, of the default aircraft
FROM_ROLL, FROM_RATE = 1.0, 0.5  # aileron per roll (1) and per roll rate (s)


def line(signal: str, steps: int, now: str, soon: str, dt: float) -> ct.StateSpace:
    """A signal `steps` samples ago, and one sample less."""
    last = np.eye(steps)[[-1, -2]]
    matrices = np.eye(steps, k=-1), np.eye(steps, 1), last, np.zeros((2, 1))
    return ct.ss(*matrices, dt, inputs=[signal], outputs=[now, soon])


def rolling(damping: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Roll and roll rate one sample later: from both, and from p now, p soon and the aileron.

    Between two samples the gust is linear, and the aileron rests.
    """
    a = np.array([[0, 1], [0, -damping / INERTIA]])
    b = np.array([[0, 0], [damping, AILERON_MOMENT]]) / INERTIA
    whole = np.zeros((5, 5))
    whole[:2] = np.hstack([a * dt, b * dt, np.zeros((2, 1))])
    whole[2, 4] = 1.0  # the slope of the gust
    step = scipy.linalg.expm(whole)[:2]
    return step[:, :2], np.column_stack([step[:, 2] - step[:, 4], step[:, 4], step[:, 3]])


def rms(block: dict, forward: float) -> tuple[float, float]:
    """Predicted rms of roll and aileron, rad.

    `forward` is the fraction of the announced rolling moment that the aileron cancels.
    """
    axes, dt = list(block["axis"]), float(block["dt"])
    gusts, white, noise, estimates = (
        [f"{kind}_{axis}" for axis in axes] for kind in ("gust", "white", "noise", "estimate")
    )
    air = ct.ss(*(block[f"gust_{name}"] for name in "ABCD"), dt, inputs=white, outputs=gusts)
    lidar = ct.ss(*(block[name] for name in "ABCD"), dt, inputs=gusts + noise, outputs=estimates)
    # the wing meets a plane so many samples after its first scan
    steps = round(float(block["arrival"]) / dt)
    wind = line("gust_p", steps, "p_now", "p_soon", dt)
    memory = line("estimate_p", steps - int(block["delay_steps"]), "e_now", "e_soon", dt)
    damping = float(block["roll_moment_per_gust"])  # -L_p, N m s/rad
    wing = ct.ss(
        *rolling(damping, dt),
        np.eye(2),
        np.zeros((2, 3)),
        dt,
        inputs=["p_now", "p_soon", "aileron"],
        outputs=["roll", "rate"],
    )
    cancel = -forward * damping / AILERON_MOMENT
    law = ct.ss(
        *([], [], [], [[cancel / 2, cancel / 2, -FROM_ROLL, -FROM_RATE]]),
        dt,
        inputs=["e_now", "e_soon", "roll", "rate"],
        outputs=["aileron"],
    )
    loop = ct.interconnect(
        [air, lidar, wind, memory, wing, law],
        inputs=white + noise,
        outputs=["roll", "aileron"],
        check_unused=False,
    )
    inputs = scipy.linalg.block_diag(np.diag(block["gust_innovations"]), block["noise_covariance"])
    states = scipy.linalg.solve_discrete_lyapunov(loop.A, loop.B @ inputs @ loop.B.T)
    found = loop.C @ states @ loop.C.T + loop.D @ inputs @ loop.D.T
    roll, aileron = np.sqrt(np.diag(found))
    return float(roll), float(aileron)


def rms_in_flights(block: dict, folder: Path, forward: float) -> float:
    """Rms of roll, rad, of the loop along recorded flights; a lost estimate announces nothing."""
    from lidar_mi.encounter.sensor_samples import flights_in, samples_of

    damping = float(block["roll_moment_per_gust"])
    decay, push = rolling(damping, float(block["dt"]))
    cancel, squares = -forward * damping / AILERON_MOMENT, []
    for flight in map(samples_of, flights_in(folder)):
        if abs(flight.distance - block["range"]) > 0.01:
            continue
        truth, found = flight.truth[:, 3], np.nan_to_num(flight.estimate[:, 3])
        x = np.zeros(2)
        for k in range(len(truth) - 1):
            aileron = cancel * (found[k] + found[k + 1]) / 2 - FROM_ROLL * x[0] - FROM_RATE * x[1]
            x = decay @ x + push @ [truth[k], truth[k + 1], aileron]
            squares.append(x[0] ** 2)
    return float(np.sqrt(np.mean(squares)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("block", type=Path, help="block_RANGE.npz of lidar-mi export")
    parser.add_argument("--flights", type=Path, help="folder of the flights that it is made from")
    options = parser.parse_args()
    block = dict(np.load(options.block))
    for forward in (0.0, 0.5, 1.0):
        roll, aileron = np.degrees(rms(block, forward))
        text = (
            f"forward {forward:.1f}: roll {roll:.2f}, aileron {aileron:.2f} degrees rms predicted"
        )
        if options.flights:
            flown = np.degrees(rms_in_flights(block, options.flights, forward))
            text += f", roll {flown:.2f} in the flights"
        print(text)
