"""How much of the wind near the rotor does a far gate of a nacelle lidar know beforehand?

The coherence of two gates over many realisations of air that evolves, beside a quadrature over the
waves of the turbulence.

    python examples/inflow.py                      # a minute
    python examples/inflow.py --out coherence.png
"""

import argparse
from itertools import pairwise

import numpy as np

import lidar_mi as lm

NEAR, FARS = 0, (1, 3, 5)  # gates
WINDOW = 256  # lines of a segment


def cross_spectra(realisations: int) -> tuple[np.ndarray, np.ndarray, dict]:
    """Frequencies (Hz), distances (m), and sums of spectra of every gate in FARS and NEAR."""
    taper = np.hanning(WINDOW)
    sums = {far: np.zeros((3, WINDOW // 2 + 1), complex) for far in FARS}
    for seed in range(1, realisations + 1):
        experiment = lm.load_experiment("inflow", seed=seed)
        lines = lm.run(experiment).results["coherent_lines"]
        wind = -lines["radial_velocity"].transpose("time", "range").values
        distance = lines["range"].values
        speed = -experiment.doppler.air.wind[0]
        period = experiment.doppler.scan.repeat
        for far, sum_ in sums.items():
            # the far gate sees the same air earlier
            delay = round((distance[far] - distance[NEAR]) / speed / period)
            for start in range(0, len(wind) - delay - WINDOW + 1, WINDOW // 2):
                first = np.fft.rfft(taper * _calm(wind[start : start + WINDOW, far]))
                then = np.fft.rfft(taper * _calm(wind[start + delay :][:WINDOW, NEAR]))
                sum_ += then * first.conj(), abs(first) ** 2, abs(then) ** 2
    return np.fft.rfftfreq(WINDOW, period), distance, sums


def _calm(wind: np.ndarray) -> np.ndarray:
    return wind - wind.mean()


def expected(frequency: float, distance: float, air: dict) -> float:
    """Squared coherence over a distance along the wind, by quadrature over wave vectors.

    Large eddies carry small ones past (Tennekes, J. Fluid Mech. 67, 561, 1975): a wave k has normal
    frequencies of standard deviation sigma k about those of the mean wind. Gates, m long, and
    pulses of this full width at half maximum average along the beam.
    """
    speed, sigma, length = air["speed"], air["sigma"], air["length"]
    middle = 2 * np.pi * frequency / speed
    along = np.linspace(-0.6 * middle - 0.02, 3 * middle + 0.05, 3000)[:, None]
    across = np.exp(np.linspace(np.log(1e-5), np.log(2 * np.pi / air["shortest"]), 300))
    k = np.hypot(along, across)
    # von Karman's E(k) / k^4 times across^2 and the area of a ring of d ln(across)
    density = k**4 / (1 + (1.339 * length * k) ** 2) ** (17 / 6) / k**4 * across**4
    rate = (2 * np.pi * frequency - speed * along) / (sigma * k)
    weight = (density * np.exp(-(rate**2) / 2) / (sigma * k)).sum(axis=1)
    gate = np.sinc(along[:, 0] * air["gate"] / (2 * np.pi))
    pulse = np.exp(-((along[:, 0] * air["pulse"] / 2.355) ** 2) / 2)
    weight *= (gate * pulse) ** 2
    met = (weight * np.exp(1j * along[:, 0] * distance)).sum()
    return float(abs(met) ** 2 / weight.sum() ** 2)


def main(realisations: int, out: str | None) -> list[tuple[float, float, float, float]]:
    """Distance (m), middle of a band (Hz), measured and expected coherence."""
    frequency, distance, sums = cross_spectra(realisations)
    doppler = lm.load_experiment("inflow").doppler
    air = {"speed": -doppler.air.wind[0], **doppler.air.turbulence.model_dump()}
    air |= {"gate": doppler.laser.gate_length, "pulse": doppler.laser.pulse_length}
    edges = np.array([0.006, 0.012, 0.03, 0.06, 0.1, 0.15])
    rows = []
    for far, (cross, first, then) in sums.items():
        apart = distance[far] - distance[NEAR]
        for low, high in pairwise(edges):
            band = (frequency >= low) & (frequency < high)
            measured = abs(cross[band].sum()) ** 2 / (first[band].sum() * then[band].sum()).real
            theory = np.mean([expected(one, apart, air) for one in frequency[band]])
            rows.append((apart, float(frequency[band].mean()), float(measured), float(theory)))
            print("{:4.0f} m  {:.3f} Hz  measured {:.2f}  expected {:.2f}".format(*rows[-1]))
    if out:
        _draw(rows, out)
    return rows


def _draw(rows: list, out: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 3.6), layout="constrained")
    axes = figure.subplots()
    for number, apart in enumerate(dict.fromkeys(row[0] for row in rows)):
        _, at, measured, theory = np.array([row for row in rows if row[0] == apart]).T
        axes.plot(at, theory, color=f"C{number}", label=f"{apart:.0f} m apart, expected")
        axes.plot(at, measured, "o", color=f"C{number}", label="two gates of the lidar")
    axes.set(xlabel="frequency, Hz", ylabel="squared coherence", xscale="log", ylim=(0, 1))
    axes.legend(fontsize="small", frameon=False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--realisations", type=int, default=16)
    parser.add_argument("--out", help="a picture, .png")
    options = parser.parse_args()
    main(options.realisations, options.out)
