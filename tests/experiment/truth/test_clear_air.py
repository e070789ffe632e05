"""Molecules of the site: detects 1 % in their backscatter, a wrong altitude, a sounding that is not
read or read in wrong units, particles and molecules counted twice, and a default that is silent.
"""

import numpy as np
import pytest

import lidar_mi as lm
from lidar_mi.errors import InputError
from lidar_mi.experiment.graph import call
from lidar_mi.experiment.run import prepare
from lidar_mi.experiment.stages.light_budget import backscatter_fractions, fractions_in_words
from lidar_mi.experiment.stages.ring_images import air_line
from lidar_mi.experiment.truth.clear_air import air_of, clear_air, in_air_of_its_site

# U.S. Standard Atmosphere 1976: geometric altitude z (m), hPa, K. The tropopause is defined at the
# geopotential altitude H = 11 km, with 226.32 hPa and 216.65 K; below it T = 288.15 K - 6.5 K/km H
# and p follows T^5.25588, with H = r z / (r + z) and r = 6356.766 km
STANDARD = ((0, 1013.25, 288.15), (5000, 540.48, 255.676), (11019, 226.32, 216.65))


def experiment(**keys):
    wake = {"file": None, "time": None, "vortex_pair": {}, "spacing": "1 m"}
    lidar, wake = {}, wake | keys.pop("wake", {"extinction": {"molecules": "auto"}})
    if "wavelength" in keys:
        lidar = {"wavelength": keys.pop("wavelength")}
    return lm.load_experiment("wake_backscatter", wake=wake, lidar=lidar, **keys)


def air(**keys):
    return call(clear_air, experiment(**keys))


def test_backscatter_at_sea_level():
    """355 nm: 2.759e-26 cm^2 a molecule (Bodhaine et al. 1999) and 2.547e25 molecules per m^3; the
    backscatter is 8.0e-6 / m / sr to 1 %."""
    found = air(wavelength="355 nm")
    assert found.backscatter == pytest.approx(8.0e-6, rel=0.01)
    assert found.extinction == pytest.approx(2.759e-30 * 2.547e25, rel=1e-3)


@pytest.mark.parametrize("altitude, pressure, temperature", STANDARD)
def test_altitude_thins_the_air(altitude, pressure, temperature):
    ground, above = air(), air(site={"altitude": altitude})
    density = pressure / 1013.25 * 288.15 / temperature
    assert above.extinction / ground.extinction == pytest.approx(density, rel=1e-3)
    assert above.backscatter / ground.backscatter == pytest.approx(density, rel=1e-3)


def test_sounding_is_interpolated(tmp_path):
    """Between its levels as an isothermal atmosphere, whose pressure is exponential."""
    file = tmp_path / "sounding.csv"
    file.write_text("altitude (km), pressure (hPa), temperature (K)\n0, 1000, 270\n2, 800, 270\n")
    cold = air(site={"altitude": "1 km", "sounding": str(file)})
    density = (1000 * 800) ** 0.5 / 1013.25 * 288.15 / 270
    assert cold.extinction / air().extinction == pytest.approx(density, rel=1e-9)
    with pytest.raises(InputError, match=r"site.altitude: 3000 m .* has 0 to 2000 m"):
        air(site={"altitude": "3 km", "sounding": str(file)})


@pytest.mark.parametrize(
    "text, message",
    [
        ("altitude (m), pressure (hPa)\n0, 1013\n9, 1012\n", "temperature missing"),
        (
            "altitude (m), pressure (hPa), temperature (K)\n9, 1, 200\n0, 1, 200\n",
            "altitude: 0 m in row 2 after 9 m",
        ),
        ("altitude, pressure, temperature\n0, 1013, 288\n9, 1012, 288\n", "pressure: without a"),
        (
            "altitude (m), pressure (Pa), temperature (K)\n0, 1013, 288\n9, 1012, 288\n",
            r"pressure: 10.13 hPa at 0 m is not allowed; expected 506.6 to 2026 hPa",
        ),
        ("altitude (m), pressure (hPa), temperature (degC)\n0, 1013, 15\n9, 1012, 15\n", "273.15"),
        (
            "altitude (m), pressure (hPa), temperature (K)\n0, 1e3, 0\n9, 1e3, 2\n",
            "temperature: 0 K",
        ),
    ],
)
def test_soundings_that_cannot_be_used(tmp_path, text, message):
    (tmp_path / "sounding.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        air(site={"sounding": str(tmp_path / "sounding.csv")})


@pytest.mark.parametrize(
    "scattering",
    [
        {"phase": "molecules", "aerosol": None},
        {"phase": "isotropic", "aerosol": None},
        {
            "phase": "mixture",
            "aerosol": None,
            "parts": [
                {"phase": "molecules", "fraction": 1},
                {"phase": "aerosol", "aerosol": "dust", "fraction": 1},
            ],
        },
    ],
)
def test_air_that_has_its_molecules_is_given_no_others(scattering):
    assert air(scattering=scattering).extinction == 0


def test_stated_extinction_and_none():
    assert air(wake={"extinction": {"molecules": "0.05 / km"}}).extinction == 5e-5
    assert air(wake={"extinction": {"molecules": 0}}).backscatter == 0


def test_a_flight_has_the_air_of_its_altitude():
    flight = lm.load_experiment("encounter", **{"wake.extinction.molecules": "auto"})
    at_start = flight.encounter.path.altitude
    assert call(clear_air, flight) == air(site={"altitude": at_start})


def test_fractions_of_the_backscatter():
    """Of a uniform background: both coefficients, from the lidar ratio of the particles."""
    asked = experiment(wake={"extinction": {"molecules": "auto", "background": "0.1 / km"}})
    results = prepare(asked).results
    needed = {name: results[name] for name in ("truth", "air", "clear_air")}
    found = call(backscatter_fractions, asked, **needed)
    by_molecules = results["clear_air"].backscatter
    by_aerosol = (
        1e-4 / 75.715
    )  # lidar ratio of the shipped spheroids, sr, in the head of their table
    assert found.molecules == pytest.approx(by_molecules / (by_molecules + by_aerosol), abs=5e-3)
    assert found.exhaust == 0
    assert sum(found) == pytest.approx(1)
    assert "exhaust" not in fractions_in_words(found, asked.scattering)


def test_a_file_that_says_nothing_is_told_of_its_molecules():
    silent = lm.load_experiment("encounter").model_dump(mode="json", exclude_unset=True)
    silent["wake"].pop("extinction")
    silent["name"] = "old"
    del silent["encounter"]
    from lidar_mi.schema.reading import check

    said = [text for text in prepare(check(silent, "")).warnings if "molecules" in text]
    assert len(said) == 1
    assert "not set" in said[0] and "molecules 5" in said[0]
    assert not [text for text in prepare(experiment()).warnings if "molecules" in text]


def test_a_site_of_whose_air_the_images_have_nothing_is_told():
    aerosol_alone = {"extinction": {"molecules": 0}}
    told = prepare(experiment(site={"altitude": "600 m"}, wake=aerosol_alone))
    assert [text for text in told.warnings if text.startswith("site: the images have none")]
    asked = prepare(experiment(site={"altitude": "600 m"}))
    assert not [text for text in asked.warnings if text.startswith("site")]


def doppler_lidar(**keys):
    found = lm.load_experiment("fringes", **keys)
    return in_air_of_its_site(found, found.folder).doppler.lidar


@pytest.mark.parametrize("altitude, pressure, temperature", STANDARD)
def test_a_doppler_lidar_is_in_the_air_of_the_site(altitude, pressure, temperature):
    """355 nm: 2.759e-26 cm^2 a molecule (Bodhaine et al. 1999), 8.0e-6 / m / sr at sea level."""
    there = doppler_lidar(**{"site.altitude": altitude, "doppler.lidar.wavelength": "355 nm"})
    density = pressure / 1013.25 * 288.15 / temperature
    assert there.altitude == altitude
    assert there.extinction == pytest.approx(2.759e-30 * 2.547e25 * density, rel=2e-3)
    assert there.backscatter == pytest.approx(8.0e-6 * density, rel=0.01)


def test_what_a_doppler_lidar_says_itself_stays():
    usual = doppler_lidar()
    stated = doppler_lidar(
        **{
            "site.altitude": 1000,
            "doppler.lidar.altitude": 3000,
            "doppler.lidar.aerosol_fraction": 0.5,
            "doppler.lidar.extinction": "0.2 / km",
        }
    )
    assert usual.altitude == 8500
    assert (stated.altitude, stated.extinction) == (3000, 2e-4)
    clear = doppler_lidar(**{"site.altitude": 3000})
    # as much light of aerosol as of molecules
    assert stated.backscatter == pytest.approx(2 * clear.backscatter, rel=1e-9)


def test_a_doppler_lidar_is_in_the_air_of_a_sounding(tmp_path):
    """Density by the gas law; the width of the molecules' line by the root of the temperature."""
    file = tmp_path / "sounding.csv"
    file.write_text("altitude (km), pressure (hPa), temperature (K)\n0, 900, 250\n2, 900, 250\n")
    keys = {"doppler.lidar.wavelength": "355 nm", "doppler.lidar.line_shape": "rayleigh"}
    keys |= {"doppler.lidar.laser_width": "50 MHz"}
    standard = doppler_lidar(**keys, **{"site.altitude": 0})
    cold = doppler_lidar(**keys, **{"site.altitude": "1 km", "site.sounding": str(file)})
    assert (cold.altitude, *air_of(cold)) == pytest.approx((1000, 90000, 250))
    density = 900 / 1013.25 * 288.15 / 250
    assert cold.backscatter / standard.backscatter == pytest.approx(density, rel=1e-6)
    # a Gaussian of standard deviation s has the characteristic function exp(-2 (pi s t)^2)
    time = np.array([1e-10])
    decay = [-np.log(abs(air_line(lidar).characteristic(time)[0])) for lidar in (cold, standard)]
    assert decay[0] / decay[1] == pytest.approx(250 / 288.15, rel=2e-3)
    with pytest.raises(InputError, match=r"3000 m .* has 0 to 2000 m"):
        doppler_lidar(**{"site.altitude": "3 km", "site.sounding": str(file)})


def test_a_site_that_a_doppler_lidar_on_the_ground_cannot_use():
    with pytest.raises(InputError, match="site: not allowed"):
        lm.load_experiment("airport", **{"site.altitude": 100})


def test_the_air_of_the_site_survives_a_record(tmp_path):
    """What a run or a flight computes is of that air, and computed again it is the same."""
    prepared = prepare(lm.load_experiment("fringes", **{"site.altitude": 1000})).experiment
    assert prepared.doppler.lidar.altitude == 1000
    from lidar_mi.schema.reading import dump

    file = tmp_path / "again.yaml"
    file.write_text(dump(prepared))
    assert prepare(lm.load_experiment(file)).experiment.doppler == prepared.doppler
