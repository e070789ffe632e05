"""Lines of sight to wind vectors, and both lidars combined."""
