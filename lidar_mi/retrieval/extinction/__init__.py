"""Extinction along a beam from its range profile, by single scattering in closed form."""
