"""Displacement and wind from images or volumes."""
