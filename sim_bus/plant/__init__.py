"""The shaft that the simulated drive turns: rigid, of two masses, or with a drill string; with its dry friction."""
