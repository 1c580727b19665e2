"""Telling a simulated peer which stage of the protocol begins: its scripted faults wait for it."""

from __future__ import annotations

from contextlib import suppress

from drivers.errors import CommunicationLost
from drivers.modbus.access import Access
from drivers.modbus.errors import RegisterRefused
from profiles.simulator_marker import MARKER_STAGE_REGISTER, STAGE_NUMBERS

_LONGEST_S = 0.05
"""For the reply, in the middle of a run: a rehearsal must not cost the run its beat."""


def tell_stage(access: Access, stage: str) -> None:
    """One request, asked once; whether it gets through is the peer's concern. Anything but a stage is not told."""
    number = STAGE_NUMBERS.get(stage)
    if number is None:
        return
    request = access.write_request(MARKER_STAGE_REGISTER, (number,))
    with suppress(CommunicationLost, RegisterRefused):
        access.once(request, _LONGEST_S, f"register {MARKER_STAGE_REGISTER}")
