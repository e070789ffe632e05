"""The picture: Mitsuba scenes, running them, EXR files in and out."""
