"""Line-of-sight speed from ring images."""
