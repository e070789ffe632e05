"""What observes in flight: scans of slabs ahead, their winds and vortices, and when they arrive."""
