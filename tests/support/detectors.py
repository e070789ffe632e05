"""A detector that counts every photon and adds nothing, and energies of given photon numbers."""

from lidar_mi.instrument.detector import Detector

# nothing but the Poisson noise of the signal
IDEAL = Detector(
    optics_efficiency=1,
    quantum_efficiency=1,
    excess_noise_factor=1,
    dark_rate=0,
    sky_radiance=0,
    speckle=False,
)


def ideal(**changes):
    return IDEAL.model_copy(update=changes)


def s0_of(photons):
    """Received over emitted energy of that many photons with the paper's lidar (1 mJ, 532 nm)."""
    return photons * 3.73393e-19 / 1e-3
