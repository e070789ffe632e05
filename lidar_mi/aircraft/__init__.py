"""The aircraft: its state and models, the loads of the wind on it, and what steers it."""
