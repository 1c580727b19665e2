"""What stands beside a result: J by other routes through the same run, and the friction curve."""
