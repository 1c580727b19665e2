"""One room of tests for each room of the source; helpers are imported by their full names (`tests.path.path_runs`)."""
