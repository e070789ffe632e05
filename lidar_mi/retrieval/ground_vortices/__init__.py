"""Vortices of a wake from scans of a Doppler lidar on the ground."""
