"""lidar-mi: virtual lidars that look at wake vortices."""

__version__ = "0.1.0"
