"""``python -m lidar_mi.cli``."""

from lidar_mi.cli.app import main

main()
