"""The tests: one folder for each room of lidar_mi, `support` for what several of them use."""
