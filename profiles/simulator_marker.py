"""The marker by which a simulated drive shows that it is simulated.

A simulator may show a vendor's identity, so identity proves nothing. In addition it has this object, in the
manufacturer's range. No real drive has it.
"""

MARKER_INDEX = 0x5FFE
"""Record. Sub 1 (VISIBLE_STRING, ro): `MARKER_TEXT`. Sub 2 (UNSIGNED8, rw): 1 = stepped time, 0 = its own clock. Sub 3
(UNSIGNED32, rw): period of a SYNC in stepped time, µs, for a simulated drive without 1006h. Sub 4 (UNSIGNED8, rw): the
current stage of the run, by `STAGE_NUMBERS`, 0 before the first. Scripted faults of the simulator wait for it. The
stage is sent to simulated peers only."""

MARKER_TEXT = "tdhil simulated drive"

MARKER_REGISTER = 0xFDE8
"""Modbus: first holding register of `MARKER_TEXT` in ASCII, two characters a register, high byte first, padded with
zeros to `MARKER_REGISTERS` registers. The register after them reads 1 in stepped time, else 0."""

MARKER_REGISTERS = 12

MARKER_STAGE = 4
"""Subindex of `MARKER_INDEX` to which the host writes the stage."""

MARKER_STAGE_REGISTER = MARKER_REGISTER + MARKER_REGISTERS + 1
"""Modbus: holding register after that of stepped time, to which the host writes the stage (function 6 or 16)."""

STAGE_NUMBERS = {"setup": 1, "speed": 2, "torque": 3, "hold": 4, "acquire": 5}
"""The five stages as sent to a simulated peer."""

CYCLE_ID = 0x6FE
"""Identifier of frames about the cycles of stepped time, between a host and a simulated drive only. In stepped time
nothing is late, so there is no time-out: it would make a run depend on the load of the computer.

`CYCLES_END` (one byte, from a drive with scripted faults): from this SYNC on, the drive ends each cycle with
`CYCLE_OVER`, or with `LAST_CYCLE_OVER` when it stops doing so. `CYCLE_ASKED` and a number (from a host that gets no
frame): the drive replies with `CYCLE_ANSWER` and the same number. By then the drive has sent all its answers to earlier
frames; a missing one was lost. Both frames are never dropped by a scripted fault, because they are not frames of the
simulated bus. CiA 301 keeps 6E1h to 6FFh free of other uses."""

LAST_CYCLE_OVER, CYCLE_OVER, CYCLES_END = b"\x00", b"\x01", b"\x02"
CYCLE_ASKED, CYCLE_ANSWER = b"\x03", b"\x04"
"""First byte of a question and of its answer; the second is the number of the question."""
