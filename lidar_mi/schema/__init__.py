"""What an experiment file may say: one file a section."""
