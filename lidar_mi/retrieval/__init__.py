"""The estimate: displacements between two images, and the wind that follows."""
