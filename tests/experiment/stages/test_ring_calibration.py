"""The instrument that a run's retrieval assumes, before and after its calibration.

Detects: a calibration that the retrieval does not use, one that starts from the true instrument,
stated errors that do not hold, a file of another camera found only after the images.
"""

import math

import numpy as np
import pytest

from lidar_mi.atmosphere.scattering.line import laser_line
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.log import Log
from lidar_mi.experiment.stages.ring_calibration import assumed_rings, calibration_file
from lidar_mi.experiment.stages.ring_images import exposed_frames, ring_instrument
from lidar_mi.experiment.stages.ring_instrument import pixel_noise
from lidar_mi.experiment.stages.ring_velocities import speeds_to_laser
from lidar_mi.instrument.fringe_camera import fringe_image
from lidar_mi.io.netcdf import write_netcdf
from lidar_mi.retrieval.rings.calibration_fit import calibrate_rings
from lidar_mi.schema.reading import check

# 4 x 4 of the default camera's pixels in one
CAMERA = {"width": 240, "height": 195, "pixel": "29.6 um"}
WRONG = {"focal_length": "300.6 mm", "reflectivity": 0.67}
SPEED, PULSES = 300.0, 12
QUIET = Log()


def experiment(**doppler):
    given = {
        "camera": CAMERA,
        "ccd": {"full_well": 1e7},
        "v_los": [SPEED],
        "retrieval": {"background_degree": 0},
    }
    return check({"name": "small", "seed": 4, "doppler": given | doppler}, "small")


def laser_image(asked, rings):
    doppler = asked.doppler
    own = laser_line(doppler.lidar.wavelength, doppler.lidar.laser_width)
    return fringe_image(doppler.camera, doppler.etalon, own, 0.0, rings.photons)


def retrieved(asked):
    """Difference to the laser's frames of single pulses, (3, pulses), and the model."""
    doppler, rings = asked.doppler, ring_instrument(asked.doppler)
    assumed = call(assumed_rings, asked, rings=rings, calibration_file=None, log=QUIET)
    air = fringe_image(doppler.camera, doppler.etalon, rings.line, SPEED, rings.photons)
    frames = exposed_frames(doppler, rings, air, 1, asked.seed, range(PULSES))
    laser = exposed_frames(
        doppler, rings, laser_image(asked, rings), 1, asked.seed, range(100, 100 + PULSES)
    )
    noises = [pixel_noise(doppler.ccd, rings.modes)] * 2
    return speeds_to_laser(frames, laser, doppler, assumed, noises, "annular", "free"), assumed


@pytest.mark.slow
def test_calibrated_instrument():
    """Biased with the wrong instrument; with the calibrated one within the stated errors."""
    before, _ = retrieved(
        experiment(assumed=WRONG, retrieval={"background_degree": 0, "max_chi_square": math.inf})
    )
    after, assumed = retrieved(experiment(assumed=WRONG, calibration={"frames": 8}))
    random = np.sqrt((after[1] ** 2).mean() / PULSES)
    # the rings' squared radii, and so the difference of orders, are wrong by 0.4 %
    assert abs(before[0].mean() - SPEED) > 0.2
    total = math.hypot(random, after[2].mean())
    assert abs(after[0].mean() - SPEED) < 4 * total
    assert total < 0.1
    assert assumed.model.focal_length == pytest.approx(0.3, rel=1e-5)
    assert before[2].max() == 0
    assert after[2].min() > 0
    normal = (after[0] - after[0].mean()) / after[1]
    assert abs(float((normal**2).sum()) / (PULSES - 1) - 1) < 4 * math.sqrt(2 / (PULSES - 1))


@pytest.mark.slow
def test_hot_and_dead_pixels_are_masked():
    """0.1 % hot, 0.1 % dead: hot ones are left out, and speeds are right within their errors."""
    ccd = {"full_well": 1e7, "hot_pixels": 0.001, "dead_pixels": 0.001}
    after, assumed = retrieved(experiment(ccd=ccd, calibration={"frames": 8}))
    total = math.hypot(np.sqrt((after[1] ** 2).mean() / PULSES), after[2].mean())
    assert abs(after[0].mean() - SPEED) < 4 * total
    assert total < 0.1
    # dead pixels between rings are nearly as dark as their neighbours
    left_out = int((assumed.response == 0).sum())
    assert 47 + 10 <= left_out <= 2 * 47 + 5


@pytest.mark.slow
def test_calibration_of_a_file(tmp_path):
    asked = experiment(calibration={"file": "etalon.nc"})
    rings = ring_instrument(asked.doppler)
    with pytest.raises(InputError, match=r"calibration\.file: .*etalon.nc not found"):
        call(calibration_file, asked, rings=rings, search_path=tmp_path, log=QUIET)
    frames = exposed_frames(asked.doppler, rings, laser_image(asked, rings), 1, 9, range(2))
    found = calibrate_rings(frames, rings.laser, pixel_noise(asked.doppler.ccd, rings.modes))
    write_netcdf(found.to_dataset(), tmp_path / "etalon.nc")
    known = call(calibration_file, asked, rings=rings, search_path=tmp_path, log=QUIET)
    assumed = call(assumed_rings, asked, rings=rings, calibration_file=known, log=QUIET)
    assert assumed.model.focal_length == found.focal_length
    np.testing.assert_array_equal(assumed.laser.systematic, found.systematic)
    other = experiment(camera=CAMERA | {"width": 260}, calibration={"file": "etalon.nc"})
    with pytest.raises(InputError, match=r"calibration\.file: .*195 x 240 and 195 x 260"):
        call(
            calibration_file,
            other,
            rings=ring_instrument(other.doppler),
            search_path=tmp_path,
            log=QUIET,
        )


def test_without_calibration_the_assumed_instrument_is_taken():
    asked = experiment(assumed=WRONG)
    rings = ring_instrument(asked.doppler)
    assumed = call(assumed_rings, asked, rings=rings, calibration_file=None, log=QUIET)
    found = rings.model.focal_length, assumed.model.focal_length
    assert found == pytest.approx((0.3, 0.3006), rel=1e-12)
    assert assumed.model.systematic is None
    # harmonics of a mirror are powers of its reflectivity
    ratio = [abs(r.laser.harmonics[0, 2] / r.laser.harmonics[0, 1]) for r in (assumed, rings)]
    assert ratio[0] / ratio[1] == pytest.approx(0.67 / 0.70, rel=1e-9)


def test_one_origin():
    with pytest.raises(InputError, match="frames: not allowed with file"):
        experiment(calibration={"file": "etalon.nc", "frames": 3})
