"""A room of tests for each room of the house; helpers are imported by their full names (`tests.path.path_runs`)."""
