"""Von Karman's turbulence in closed form, for tests and validation."""

import numpy as np
from scipy import integrate, signal, special


def correlations(r, length):
    """Longitudinal and transverse correlation f and g (Hinze 1975, eq. 3-168 and 3-169)."""
    x = np.asarray(r, float) / (1.339 * length)
    scale = 2 ** (2 / 3) / special.gamma(1 / 3)
    f = scale * x ** (1 / 3) * special.kv(1 / 3, x)
    g = scale * x ** (1 / 3) * (special.kv(1 / 3, x) - x / 2 * special.kv(2 / 3, x))
    return f, g


def line_spectra(k1, sigma, length, shortest=None):
    """Of u and w along x over k1 > 0, m^3 s^-2 (MIL-F-8785C, 3.7.1.2; CS 25.341(b)(2)).

    Of a field without waves shorter than ``shortest``: less what they add, by Batchelor's relations
    in the inertial range.
    """
    k1 = np.asarray(k1, float)
    q = (1.339 * length * k1) ** 2
    longitudinal = sigma**2 * 2 * length / np.pi / (1 + q) ** (5 / 6)
    transverse = sigma**2 * length / np.pi * (1 + 8 / 3 * q) / (1 + q) ** (11 / 6)
    if shortest is not None:
        last = 2 * np.pi / shortest
        scale = sigma**2 * length * 55 / (9 * np.pi) * (1.339 * length) ** (-5 / 3)
        first, second = 3 / 5 * last ** (-5 / 3), 3 / 11 * k1**2 * last ** (-11 / 3)
        longitudinal = np.where(k1 < last, longitudinal - scale * (first - second), 0.0)
        transverse = np.where(k1 < last, transverse - scale * (first + second) / 2, 0.0)
    return longitudinal, transverse


def finer_variance(sigma, length, shortest):
    """Variance of a component in waves shorter than ``shortest``, from the energy spectrum."""

    def energy(s):
        q = (1.339 * length * np.exp(s)) ** 2
        spectrum = sigma**2 * length * 55 / (9 * np.pi) * q**2 / (1 + q) ** (17 / 6)
        return np.exp(s) * spectrum

    limits = np.log(2 * np.pi / shortest), np.log(1e6)
    return 2 / 3 * integrate.quad(energy, *limits, limit=200)[0]


def plunge_variance(sigma, length, shortest, speed, tau):
    """Of the acceleration of a point mass with lift: the integral of its spectrum times |H|^2.

    tau w' = gust - w: H = i omega / (1 + i omega tau).
    """

    def integrand(s):
        k1 = np.exp(s)
        omega = k1 * speed
        density = float(line_spectra(k1, sigma, length, shortest)[1])
        return k1 * density * omega**2 / (1 + (omega * tau) ** 2)

    limits = np.log(1e-6), np.log(2 * np.pi / shortest)
    return integrate.quad(integrand, *limits, limit=300)[0]


def roll_rate_variance(sigma, length, model):
    """Of the roll rate of a `RollModel`: from the correlation of w between all of its strips.

    I p' = L_p p + sum c_i w_i: <p^2> = tau / I^2 integral of R_L(t) exp(-t/tau), with
    R_L(t) = sum c_i c_j R_ww(V t, y_i - y_j).
    """
    strips, speed = model.strips, model.state.airspeed
    y = strips.places[:, 1]
    weight = 0.5 * model.density * speed * strips.areas * strips.roll_slopes * y
    between = np.abs(y[:, None] - y)
    tau = model.time_constant

    def integrand(lag):
        # across the separation in x and in y; on the diagonal at lag 0 it is 1
        r = np.maximum(np.hypot(speed * lag, between), 1e-6)
        moment = sigma**2 * float(weight @ correlations(r, length)[1] @ weight)
        return moment * np.exp(-lag / tau)

    found = integrate.quad(integrand, 0, 20 * tau, limit=100, epsrel=1e-4)[0]
    return found * tau / model.roll_inertia**2


def plunge(gust, step, tau):
    """Acceleration of a point mass with lift, by scipy; the gust is linear between its times."""
    return signal.lsim(([1.0, 0.0], [tau, 1.0]), gust, step * np.arange(len(gust)))[1]
