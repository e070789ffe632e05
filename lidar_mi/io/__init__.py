"""Files in and out: one reader and one writer for each kind."""
