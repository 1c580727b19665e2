"""Pretends to be the drive and the shaft: plant, inverter, and their face on the bus."""
