"""Inversion of the renderer: air that makes the counts of a lidar most probable."""
