"""How often the interval covers: seeded plants, identified by the hundred."""
