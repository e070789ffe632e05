"""Figures, from data sets to PNG."""
