"""Families of air of the vortex tracks.

Errors this detects: a wave that is no gravity wave, buoyancy that makes a pair sink faster.
"""

from dataclasses import replace

import numpy as np

from lidar_mi.atmosphere.vortices.vortex import descent_speed
from validation import pairs_in_air

STRATIFIED = next(f for f in pairs_in_air.FAMILIES if f.stability)


def test_layers_are_as_strong_as_stable_air_allows():
    for seed in range(20):
        level, wave = pairs_in_air._layers(STRATIFIED, np.random.default_rng(seed))
        for layer in (level, wave):
            np.testing.assert_allclose(np.dot(layer.amplitudes, layer.wave), 0, atol=1e-12)
        richardson = STRATIFIED.stability**2 / (level.amplitudes[0] * level.wave[1]) ** 2
        np.testing.assert_allclose(richardson, 0.25)
        # vertical displacement by the wave: w over its frequency N |k_y| / |k|
        frequency = STRATIFIED.stability * abs(wave.wave[0]) / np.hypot(*wave.wave)
        steepness = abs(wave.wave[1] * wave.amplitudes[1]) / frequency
        np.testing.assert_allclose(steepness, 1.0)


def test_buoyancy_slows_the_descent():
    random = np.random.default_rng(1)
    sunk = []
    for stability in (0.0, 0.02, 0.03):
        family = replace(STRATIFIED, stability=stability)
        pair = pairs_in_air._start(family, random)
        sunk.append(-pairs_in_air._speeds(family, pair, [])[:2, 1].mean() + pairs_in_air.MEAN[1])
    straight = descent_speed(350.0, STRATIFIED.separation)
    np.testing.assert_allclose(sunk[0], straight, rtol=0.01)
    # the vorticity is proportional to the square of the frequency
    np.testing.assert_allclose(straight - sunk[2], 2.25 * (straight - sunk[1]), rtol=0.05)
    assert sunk[2] < sunk[1] < straight
