"""One run, from what was asked for to a closed log: which drive, who confirms, where the files go."""
