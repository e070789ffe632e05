"""The truth: flows, extinction, states in time."""
