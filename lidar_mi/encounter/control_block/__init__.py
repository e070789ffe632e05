"""The lidar of a flight as a block for control design."""
