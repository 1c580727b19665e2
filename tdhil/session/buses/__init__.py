"""What is particular to one bus in reaching a drive: where it is, and how it is opened."""
