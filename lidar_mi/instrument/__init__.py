"""The sensor: laser, telescope, scan geometry and range gates."""
