"""A flight through a wake: aircraft, slabs in time, the lidar as an object that is stepped."""
