"""One module for each bus: its options, opening a drive on it, scanning it, checking it."""
