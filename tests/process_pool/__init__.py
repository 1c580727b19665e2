"""Many logs."""
