"""A shaft that swings: two masses on a spring, or a string."""
