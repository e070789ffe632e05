"""The only room that imports all others: what an experiment is, and running it."""
