"""Figures and film of a flight: drawn, with what they claim to show.

Detects a figure that is missing or empty, a mirrored view, frames of several sizes, a caption of
another moment.
"""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from lidar_mi.assessment.figures.encounter import best_slab, draw_all, draw_image, draw_vortices
from lidar_mi.assessment.figures.encounter_film import film
from lidar_mi.experiment.log import Log
from tests.support.encounter_results import made_up_flights

SPAN = 28.9


@pytest.mark.slow
def test_all_are_drawn(tmp_path):
    found = made_up_flights()
    drawn = draw_all(tmp_path, found.series, found.track, found.slabs, SPAN, Log())
    assert [one.path.stem for one in drawn] == (
        "fig29_encounter fig30_roll fig31_approach fig32_cockpit fig33_track fig34_moment "
        "fig35_commands"
    ).split()
    for one in drawn:
        assert imread(one.path).std() > 0.05 and one.caption.endswith(".")


def test_without_a_lidar_there_is_the_flight(tmp_path):
    alone = made_up_flights().series.sel(flight=["off"])
    drawn = draw_all(tmp_path, alone, None, None, SPAN, Log())
    assert [one.path.stem for one in drawn] == ["fig30_roll", "fig35_commands"]


def test_loads_of_the_air_are_drawn(tmp_path):
    alone = made_up_flights().series.sel(flight=["off"]).assign_attrs(met="air")
    drawn = draw_all(tmp_path, alone, None, None, SPAN, Log())
    assert [one.path.stem for one in drawn] == ["fig30_roll", "fig35_commands", "fig36_loads"]
    assert imread(drawn[-1].path).std() > 0.05


def test_loads_of_an_aircraft_that_rises_are_drawn(tmp_path):
    alone = made_up_flights().series.sel(flight=["off"])
    changed = {
        name: alone["roll"] * factor
        for name, factor in (
            ("load_factor", 2.0),
            ("port_bending", 1e5),
            ("starboard_bending", 1e5),
        )
    }
    drawn = draw_all(tmp_path, alone.assign(changed), None, None, SPAN, Log())
    assert [one.path.stem for one in drawn] == ["fig30_roll", "fig35_commands", "fig37_load_factor"]
    assert imread(drawn[-1].path).std() > 0.05


def test_cockpit_is_the_pilots_view():
    """Port, positive y, is on the left; cores are where the data set has them."""
    found = made_up_flights()
    number = best_slab(found.track, found.slabs)
    axes = Figure().subplots()
    draw_image(axes, found.slabs.isel(slab=number))
    at = found.track.isel(slab=number)
    draw_vortices(axes, at)
    left, right = axes.get_xlim()
    assert left > right
    (port, starboard) = axes.lines
    assert port.get_xdata() == pytest.approx(float(at["port_y"].sel(source="truth")))
    assert port.get_xdata() > starboard.get_xdata()
    assert [round(c.center[0], 6) for c in axes.patches] == [
        round(float(at[f"{side}_y"].sel(source="track")), 6) for side in ("port", "starboard")
    ]


def test_film_shows_the_flight(monkeypatch):
    monkeypatch.setattr("lidar_mi.assessment.figures.encounter_film.RATE", 4)
    found = made_up_flights()
    frames = list(film(found.series, found.track, found.slabs, SPAN))
    assert len({frame.pixels.shape for frame in frames}) == 1
    assert all(frame.pixels.dtype == np.uint8 and frame.pixels.std() > 10 for frame in frames)
    assert not any(n % 2 for n in frames[0].pixels.shape[:2])
    # the film's time is that of the flight, from the first delivery to the end
    start, end = float(found.slabs["delivered"].min()), float(found.series["time"].max())
    assert [frame.time for frame in frames] == pytest.approx(np.arange(start, end + 1e-6, 0.25))
    last = found.series.interp(time=frames[-1].time)
    angle = np.degrees(float(last["roll"].sel(flight="off")))
    assert f"without control {angle:+.1f}°" in frames[-1].caption
    assert list(film(found.series, None, None, SPAN)) == []


def test_film_shows_beams_only_while_the_lidar_scans(monkeypatch):
    """Cyan beams from above: as long from frame to frame, gone after the last scan."""
    monkeypatch.setattr("lidar_mi.assessment.figures.encounter_film.RATE", 4)
    found = made_up_flights()
    last_scan = float(found.slabs["time"].max()) + 0.05
    areas = []
    for frame in film(found.series, found.track, found.slabs, SPAN):
        red, green, blue = (frame.pixels[460:, :, k].astype(int) for k in range(3))
        # a quarter of cyan on white
        beams = (abs(red - 197) < 4) & (abs(green - 239) < 4) & (abs(blue - 243) < 4)
        areas.append((frame.time, int(beams.sum())))
    during = [area for time, area in areas if time < last_scan - 0.01]
    after = [area for time, area in areas if time > last_scan + 0.01]
    assert len(during) >= 2 and after and max(after) == 0
    assert min(during) > 2000 and max(during) < 1.2 * min(during)
