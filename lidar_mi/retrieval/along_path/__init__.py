"""The wind along a path from the vectors of successive slabs of air."""
