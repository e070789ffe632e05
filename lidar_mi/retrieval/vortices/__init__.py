"""Vortex parameters from images or wind vectors."""
