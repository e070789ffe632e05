"""The estimate: displacements between two images, and the wind they mean."""
