"""Experiments, Mitsuba scenes and the sample wake that ship with the package."""
