"""The only room that sees all: what an experiment is, and running it."""
