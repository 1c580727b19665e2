"""Scripted misbehaviour of one simulated Modbus drive: what is due begins and ends, requests pass through what goes on.

All of it in plant time. That the host says which stage has begun (`profiles.simulator_marker.MARKER_STAGE_REGISTER`)
belongs to the rehearsal, not to the line: no fault comes between.
"""

from functools import partial

import numpy as np

from profiles.modbus import ModbusProfile
from profiles.simulator_marker import MARKER_STAGE_REGISTER
from sim_bus.fault_script import Cast, Scripted
from sim_bus.modbus.fault_catalogue import make
from sim_bus.modbus.fault_hooks import Ask, Misbehaviour, Scene
from sim_bus.modbus.machine import Machine
from sim_bus.modbus.reply import Reply

_SEED = 0xFA17
_WRITES = (6, 16)
_STAGE_REGISTER = MARKER_STAGE_REGISTER.to_bytes(2, "big")


def tells_stage(pdu: bytes) -> bool:
    """The host says which stage has begun."""
    return len(pdu) > 3 and pdu[0] in _WRITES and pdu[1:3] == _STAGE_REGISTER


class Faults:
    """The script of one drive; from now on it happens. Requests come in by `request`."""

    def __init__(self, machine: Machine, profile: ModbusProfile, script: tuple[Scripted, ...] = (),
                 seed: int = 0) -> None:
        self._machine = machine
        self._cast: Cast[Misbehaviour] = Cast(script, make)
        scene = Scene(machine, profile, np.random.default_rng((seed, _SEED)))
        for fault in self._cast.all:
            fault.scene = scene
        if script:
            machine.on_time = self.moved
            machine.on_stage = self._on_stage
            self.moved(0)

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults whose moment hasn't come, as they were written."""
        return self._cast.waiting

    def moved(self, now_us: int) -> None:
        """Plant time has come so far."""
        if self._cast.moved(now_us, self._machine.note):
            self._machine.application.regulate()

    def request(self, pdu: bytes, connection: int = 0) -> Reply:
        """A request for the drive, at the time that it is: what comes back."""
        ask: Ask = partial(self._ask, connection=connection)
        if tells_stage(pdu):
            return ask(pdu)
        for fault in self._cast.active:
            ask = partial(fault.asked, ask=ask)
        return ask(pdu)

    def _ask(self, pdu: bytes, connection: int) -> Reply:
        return Reply(self._machine.request(pdu, connection))

    def _on_stage(self, number: int) -> None:
        now_us = round(1e6 * self._machine.time_s)
        self._cast.stage(number, now_us)
        self.moved(now_us)
