"""Mitsuba plugins: how light moves, and how a lidar sends and receives it."""
