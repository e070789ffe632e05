"""Errors of winds on families of flows that took no part in building the retrieval."""
