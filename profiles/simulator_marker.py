"""How a simulated drive says that it is one.

A simulator wears vendors' identities, so identity proves nothing; it bears this object besides, in the
manufacturer's range, and no real drive does.
"""

MARKER_INDEX = 0x5FFE
"""Record. Sub 1 (VISIBLE_STRING, ro): `MARKER_TEXT`. Sub 2 (UNSIGNED8, rw): 1 = stepped time, 0 = its own clock.
Sub 3 (UNSIGNED32, rw): period of a SYNC in stepped time, µs, for a simulated drive that wears one without 1006h.
Sub 4 (UNSIGNED8, rw): the stage of the protocol that has begun, by `STAGE_NUMBERS`, 0 before any; scripted faults of
the simulator wait for it. Told to simulated peers only."""

MARKER_TEXT = "tdhil simulated drive"

MARKER_REGISTER = 0xFDE8
"""Modbus: holding registers from here on, `MARKER_TEXT` in ASCII, two characters a register, high byte first, padded
with zeros to `MARKER_REGISTERS`; the one after them reads 1 in stepped time, else 0."""

MARKER_REGISTERS = 12

MARKER_STAGE = 4
"""The subindex of `MARKER_INDEX` that takes the stage."""

MARKER_STAGE_REGISTER = MARKER_REGISTER + MARKER_REGISTERS + 1
"""Modbus: the holding register, behind that of stepped time, that takes the stage (function 6 or 16)."""

STAGE_NUMBERS = {"setup": 1, "speed": 2, "torque": 3, "hold": 4, "acquire": 5}
"""The five stages as sent to a simulated peer."""

CYCLE_ID = 0x6FE
"""Frames about the cycles of stepped time, between a host and a simulated drive only: in stepped time nothing is late,
so there is no time-out, which would make a run depend on the load of the computer.

`CYCLES_END` (one byte, from a drive with scripted faults) says that from this SYNC on each cycle is ended by
`CYCLE_OVER`, or `LAST_CYCLE_OVER` when that ends. `CYCLE_ASKED` and a number (from a host to which nothing comes) is
answered by `CYCLE_ANSWER` and the same number: whatever the drive had to say to earlier frames has been said by then,
and what hasn't come was lost. Both pass by scripted faults, also where these let nothing else through: they are no
frames of the bus that is simulated. CiA 301 keeps 6E1h to 6FFh free of other uses."""

LAST_CYCLE_OVER, CYCLE_OVER, CYCLES_END = b"\x00", b"\x01", b"\x02"
CYCLE_ASKED, CYCLE_ANSWER = b"\x03", b"\x04"
"""Each before a byte that numbers the question."""
