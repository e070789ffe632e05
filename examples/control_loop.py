"""Close two control loops with the lidar of recorded flights, without a renderer.

A controller levels the wings of the default aircraft and cancels the roll gust that the lidar
announces; flaps cancel the lift of the announced vertical gust. Variances of roll, aileron and load
factor follow from the Lyapunov equations of a system that jumps where estimates are lost; with
--flights the same loops fly along the recorded flights, by their estimates as they were delivered
and the true wind.

    lidar-mi fly gust --mode feedforward -o outputs/air --set encounter.path.beyond='900 m'
    lidar-mi export outputs/air --format control
    python examples/control_loop.py outputs/air/control/block_151m.npz --flights outputs/air
"""

import argparse
from pathlib import Path

import control as ct
import numpy as np
import scipy

from lidar_mi.encounter.control_block.jump_linear import jump_covariance
from lidar_mi.encounter.control_block.sensor_samples import SensorSamples, flights_in, samples_of

INERTIA, AILERON_MOMENT = 8.0e5, 1.052e6  # kg m^2 and N m/rad, of the default aircraft
MASS, GRAVITY = 48500.0, 9.80665
FROM_ROLL, FROM_RATE = 1.0, 0.5  # aileron per roll (1) and per roll rate (s)


def line(axis: str, signal: str, steps: int, dt: float) -> ct.StateSpace:
    """A signal `steps` samples ago, and one sample less."""
    last = np.eye(steps)[[-1, -2]]
    matrices = np.eye(steps, k=-1), np.eye(steps, 1), last, np.zeros((2, 1))
    outputs = [f"{signal}_{axis}_now", f"{signal}_{axis}_soon"]
    return ct.ss(*matrices, dt, inputs=[f"{signal}_{axis}"], outputs=outputs)


def sampled(a: np.ndarray, b: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """States one sample later: from the states, and from gust now, gust soon and control.

    Between two samples the gust is linear, and the control rests.
    """
    n = len(a)
    whole = np.zeros((n + 3, n + 3))
    whole[:n] = np.hstack([a * dt, b * dt, np.zeros((n, 1))])
    whole[n, -1] = 1.0  # the slope of the gust
    step = scipy.linalg.expm(whole)[:n]
    soon = step[:, -1]
    return step[:, :n], np.column_stack([step[:, n] - soon, soon, step[:, n + 1]])


def aircraft(block: dict) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Roll and roll rate by p and aileron; vertical speed by w and the lift of flaps as a gust."""
    dt, damping = float(block["dt"]), float(block["roll_moment_per_gust"])  # -L_p, N m s/rad
    lift = float(block["lift_per_gust"]) / MASS
    roll = np.array([[0, 1], [0, -damping / INERTIA]])
    pushed = np.array([[0, 0], [damping, AILERON_MOMENT]]) / INERTIA
    return sampled(roll, pushed, dt), sampled(np.array([[-lift]]), np.array([[lift, lift]]), dt)


def loop(block: dict, forward: float, received: bool, hold: float) -> ct.StateSpace:
    """Gusts and noise to roll, aileron (rad) and load factor while estimates arrive, or do not.

    `forward` is the fraction of the announced gust that the controls cancel. In place of a lost
    estimate the last value counts, times `hold`.
    """
    axes, dt = list(block["axis"]), float(block["dt"])
    gusts, white, noise, estimates = (
        [f"{kind}_{axis}" for axis in axes] for kind in ("gust", "white", "noise", "estimate")
    )
    air = ct.ss(*(block[f"gust_{name}"] for name in "ABCD"), dt, inputs=white, outputs=gusts)
    lidar = ct.ss(*(block[name] for name in "ABCD"), dt, inputs=gusts + noise, outputs=estimates)
    kept, new = (0.0, 1.0) if received else (hold, 0.0)
    # the wing meets a plane so many samples after its first scan
    steps = round(float(block["arrival"]) / dt)
    parts = [air, lidar]
    for axis in "pw":
        used = ct.ss(
            kept, new, kept, new, dt, inputs=[f"estimate_{axis}"], outputs=[f"used_{axis}"]
        )
        wait = line(axis, "used", steps - int(block["delay_steps"]), dt)
        parts += [used, wait, line(axis, "gust", steps, dt)]
    (roll, pushed), (rise, lifted) = aircraft(block)
    damping, lift = float(block["roll_moment_per_gust"]), float(block["lift_per_gust"])
    gust = ["gust_p_now", "gust_p_soon"], ["gust_w_now", "gust_w_soon"]
    parts += [
        ct.ss(
            *(roll, pushed, np.eye(2), np.zeros((2, 3)), dt),
            inputs=[*gust[0], "aileron"],
            outputs=["roll", "rate"],
        ),
        ct.ss(
            *(rise, lifted, [[-1]], [[1, 0, 1]], dt), inputs=[*gust[1], "flap"], outputs=["angle"]
        ),
    ]
    cancel = -forward * damping / AILERON_MOMENT / 2
    gains = np.zeros((3, 7))
    gains[0, [0, 1, 4, 5]] = cancel, cancel, -FROM_ROLL, -FROM_RATE
    gains[1, [2, 3]] = -forward / 2
    gains[2, 6] = lift / (MASS * GRAVITY)
    seen = [f"used_{axis}_{when}" for axis in "pw" for when in ("now", "soon")]
    law = ct.ss(
        *([], [], [], gains, dt),
        inputs=[*seen, "roll", "rate", "angle"],
        outputs=["aileron", "flap", "load"],
    )
    return ct.interconnect(
        [*parts, law], inputs=white + noise, outputs=["roll", "aileron", "load"], check_unused=False
    )


def rms(block: dict, forward: float, hold: float = 0.0) -> np.ndarray:
    """Predicted rms of roll, aileron (rad) and load factor."""
    modes = [loop(block, forward, received, hold) for received in (True, False)]
    inputs = scipy.linalg.block_diag(np.diag(block["gust_innovations"]), block["noise_covariance"])
    matrices = ([getattr(mode, name) for mode in modes] for name in "ABCD")
    found = jump_covariance(*matrices, block["loss_transition"], inputs)
    return np.sqrt(np.diag(found))


def rms_in_flights(
    block: dict, flights: list[SensorSamples], forward: float, hold: float = 0.0
) -> np.ndarray:
    """Rms of roll, aileron (rad) and load factor along recorded flights."""
    damping, lift = float(block["roll_moment_per_gust"]), float(block["lift_per_gust"])
    (roll, pushed), (rise, lifted) = aircraft(block)
    squares = []
    for flight in flights:
        (w, p), (w_used, p_used) = flight.truth[:, 2:].T, flight.estimate[:, 2:].T.copy()
        for used in (w_used, p_used):
            for k in np.flatnonzero(np.isnan(used)):
                used[k] = hold * used[k - 1] if k else 0.0
        x, rising = np.zeros(2), np.zeros(1)
        for k in range(len(w) - 1):
            announced = forward * (p_used[k] + p_used[k + 1]) / 2
            aileron = -damping / AILERON_MOMENT * announced - FROM_ROLL * x[0] - FROM_RATE * x[1]
            flap = -forward * (w_used[k] + w_used[k + 1]) / 2
            load = lift / (MASS * GRAVITY) * (w[k] - rising[0] + flap)
            squares.append(np.array([x[0], aileron, load]) ** 2)
            x = roll @ x + pushed @ [p[k], p[k + 1], aileron]
            rising = rise @ rising + lifted @ [w[k], w[k + 1], flap]
    return np.sqrt(np.mean(squares, axis=0))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("block", type=Path, help="block_RANGE.npz of lidar-mi export")
    parser.add_argument("--flights", type=Path, help="folder of the flights that it is made from")
    parser.add_argument(
        "--hold", type=float, default=0.0, help="a lost estimate is the last one times this factor"
    )
    options = parser.parse_args()
    block = dict(np.load(options.block))
    flights = []
    if options.flights:
        samples = map(samples_of, flights_in(options.flights))
        flights = [one for one in samples if abs(one.distance - block["range"]) < 0.01]
    degrees = np.array([180 / np.pi, 180 / np.pi, 1.0])
    for forward in (0.0, 0.5, 1.0):
        roll, aileron, load = degrees * rms(block, forward, options.hold)
        text = f"forward {forward:.1f}: roll {roll:.2f}, aileron {aileron:.2f} degrees, "
        text += f"load factor {load:.3f} rms predicted"
        if flights:
            roll, _, load = degrees * rms_in_flights(block, flights, forward, options.hold)
            text += f", roll {roll:.2f}, load factor {load:.3f} in the flights"
        print(text)
