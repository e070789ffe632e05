"""Pixels of image files: a module for each kind of file; one number a pixel, in full depth."""
