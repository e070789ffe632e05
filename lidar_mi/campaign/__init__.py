"""Many experiments: their points, the engine, the collected data set."""
