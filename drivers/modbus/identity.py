"""Identity of the peer: whether it has the simulator's marker, and whether its time is stepped."""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import NamedTuple

from drivers.drive import PowerState
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import register_name
from drivers.modbus.pdu import NoReply, RegisterRefused
from drivers.modbus.state_machine import decode, power_state
from profiles import (
    MARKER_REGISTER,
    MARKER_REGISTERS,
    MARKER_STAGE_REGISTER,
    MARKER_TEXT,
    STAGE_NUMBERS,
    MessageCode,
)
from profiles.modbus import ModbusProfile

# ---------------------------------------------------------------------------------------------------------------------
# Sending the stage of the run to a simulated peer: its scripted faults wait for it.


_LONGEST_S = 0.05
"""Longest wait for the reply during a run, s: a rehearsal must not delay the cycle."""


def tell_stage(access: RegisterAccess, stage: str) -> None:
    """Send one request, without retries and without a check of the reply. Only stages are sent."""
    number = STAGE_NUMBERS.get(stage)
    if number is None:
        return
    request = access.write_request(MARKER_STAGE_REGISTER, (number,))
    with suppress(CommunicationLost, RegisterRefused):
        access.once(request, _LONGEST_S, f"register {MARKER_STAGE_REGISTER}")


# ---------------------------------------------------------------------------------------------------------------------

class Marker(NamedTuple):
    """Marker of the simulator. ``stepped`` is true only for a simulated peer."""

    simulated: bool
    stepped: bool


def read_marker(access: RegisterAccess) -> Marker:
    """Read the marker block and the register after it. A drive that refuses these addresses, or is silent, is real."""
    where = f"register {MARKER_REGISTER}"
    try:
        words = access.read_words("holding", MARKER_REGISTER, MARKER_REGISTERS + 1, where)
    except (RegisterRefused, NoReply):
        return Marker(False, False)
    text = struct.pack(f">{MARKER_REGISTERS}H", *words[:MARKER_REGISTERS]).rstrip(b"\0")
    simulated = text == MARKER_TEXT.encode("ascii")
    return Marker(simulated, simulated and words[MARKER_REGISTERS] == 1)


def refuse_if_driven(access: RegisterAccess, profile: ModbusProfile, where: str) -> None:
    """Refuse an enabled drive before a request could change a turning shaft's motion. Raises PreflightRefused."""
    register = profile.cycle.status.register_
    where = f"{where}, {register_name(register)}"
    try:
        status = access.read(register) & 0xFFFF
    except CommunicationLost as error:
        raise PreflightRefused(
            f"no drive answers: {error.what}",
            where=where,
            next_step="Check that it is powered, its unit number (--unit), and on a serial line baud rate, parity and "
            "the two wires' polarity", entry=MessageCode.NO_DRIVE_FOUND,
        ) from error
    if power_state(decode(profile.control, status)) is PowerState.ENABLED:
        raise PreflightRefused(
            f"the drive is enabled already (status {status:04X}h): another master commands it",
            where=where,
            next_step="Stop the shaft with that master, disable the drive there, and disconnect the master. Without a"
            " master: tdhil stop. Nothing was written to the drive",
            entry=MessageCode.ANOTHER_MASTER,
        )


def refuse_unless_stepped(marker: Marker) -> None:
    """Refuse stepped time for a peer that is not in stepped time. Raises PreflightRefused."""
    if not marker.stepped:
        what = "runs in its own time" if marker.simulated else "has no marker of the simulator"
        raise PreflightRefused(
            f"stepped time was requested, but the peer {what}",
            where=f"register {MARKER_REGISTER}",
            next_step="Remove --stepped: a real shaft moves in real time",
            entry=MessageCode.NOT_THE_SIMULATOR,
        )
