"""Vortices: models, filaments, decay, cores, and wakes as they are simulated and met."""
