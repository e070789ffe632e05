"""The speed from the signals of a few channels: fringe detectors, filters on a line's flanks."""
