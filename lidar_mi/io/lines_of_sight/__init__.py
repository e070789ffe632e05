"""Lines of sight of Doppler lidars from the files of their makers: one data set for all kinds."""
