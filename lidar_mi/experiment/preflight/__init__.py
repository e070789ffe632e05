"""Before a run: what it will do, and how long it will take."""
