"""Point clouds of other people's data sets: arrays and files, corrupted in place of our sweeps."""
