"""One run, from what was asked for to a closed log."""
