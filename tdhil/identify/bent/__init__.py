"""A rigid shaft whose friction is no straight line over speed: tried where the data contradict one that is."""
