"""What is particular to one bus: its options, opening a drive on it, scanning it, checking it."""
