"""The stages of an experiment, each from typed inputs to a typed result."""
