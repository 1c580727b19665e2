"""How a simulated drive says that it is one.

A simulator wears vendors' identities, so identity proves nothing; it bears this object besides, in the
manufacturer's range, and no real drive does.
"""

MARKER_INDEX = 0x5FFE
"""Record. Sub 1 (VISIBLE_STRING, ro): `MARKER_TEXT`. Sub 2 (UNSIGNED8, rw): 1 = stepped time, 0 = its own clock.
Sub 3 (UNSIGNED32, rw): period of a SYNC in stepped time, µs, for a simulated drive that wears one without 1006h."""

MARKER_TEXT = "tdhil simulated drive"

MARKER_REGISTER = 0xFDE8
"""Modbus: holding registers from here on, `MARKER_TEXT` in ASCII, two characters a register, high byte first, padded
with zeros to `MARKER_REGISTERS`; the one after them reads 1 in stepped time, else 0."""

MARKER_REGISTERS = 12
