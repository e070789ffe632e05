"""A pulsed coherent Doppler lidar on the ground: scans, range weighting, noise of the velocity."""
