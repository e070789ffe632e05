"""The folder of a run: record, images, resuming."""
