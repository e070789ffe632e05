"""Sixty image pairs of wakes with their true wind, and a scorer for anyone's vectors."""
