"""The wind that is expected ahead, from the estimates of slabs, and its loads."""
