"""Displacements of windows by correlation, and their errors."""
