"""Images: Mitsuba scenes and their rendering."""
