"""Simulated Markov chains."""

import numpy as np

from lidar_mi.encounter.control_block.jump_linear import stationary_distribution


def chain(random, transition, number, records=1):
    """Modes of chains from the stationary distribution; (number, records)."""
    mode = (random.random(records) > stationary_distribution(transition)[0]).astype(int)
    found = []
    for draw in random.random((number, records)):
        found.append(mode)
        mode = (draw > transition[mode, 0]).astype(int)
    return np.array(found)
