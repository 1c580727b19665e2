"""One module for each bus: the address of a drive, and how it is opened."""
