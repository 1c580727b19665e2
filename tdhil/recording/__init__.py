"""From samples to run.mcap and back to a Recording."""
