"""From the amplitudes of scattered waves to the scattering matrix of intensities."""

import numpy as np


def phase_matrix(s):
    """Z11, Z22, Z33, Z44, Z12, Z34 by Mishchenko et al. 2002, eqs. 2.106-2.121."""
    s11, s12, s21, s22 = s[..., 0, 0], s[..., 0, 1], s[..., 1, 0], s[..., 1, 1]
    p11, p12, p21, p22 = (abs(each) ** 2 for each in (s11, s12, s21, s22))
    return np.stack(
        [
            (p11 + p12 + p21 + p22) / 2,
            (p11 - p12 - p21 + p22) / 2,
            (s11 * s22.conj() + s12 * s21.conj()).real,
            (s22 * s11.conj() - s12 * s21.conj()).real,
            (p11 - p12 + p21 - p22) / 2,
            (s11 * s22.conj() + s21 * s12.conj()).imag,
        ],
        axis=-1,
    )
