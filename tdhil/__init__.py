"""Decides, records, concludes: the moment of inertia of an inverter-driven machine, with an interval that holds."""

__version__ = "0.1.0"
