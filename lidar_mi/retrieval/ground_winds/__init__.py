"""Wind from lines of sight of a Doppler lidar on the ground."""
