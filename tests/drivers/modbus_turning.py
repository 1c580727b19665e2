"""Simulated Modbus drives that a host has left turning, at the end of a line that can lose the replies only."""

import csv
import struct

from drivers.clock import SteppedClock
from drivers.drive import Command, Mode
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from profiles.library import load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams

MODBUS = [profile for name in profile_names() if isinstance(profile := load_profile(name), ModbusProfile)]
CASES = [
    (profile, mode) for profile in MODBUS for mode in Mode if mode is Mode.SPEED or profile.modes.torque
]
"""Every shipped profile, in each of its modes."""
FAST_RAD_S = 3.0
FREE = {"switch on disabled", "ready to switch on", "switched on", "fault"}
"""States of the simulated drive without torque."""


def written(pdu):
    """Return the registers that a request writes, as [(address, word)]."""
    if pdu[0] == 6:
        return [struct.unpack(">HH", pdu[1:5])]
    if pdu[0] not in (16, 23):
        return []
    at = 1 if pdu[0] == 16 else 5
    address, count = struct.unpack_from(">HH", pdu, at)
    return list(enumerate(struct.unpack_from(f">{count}H", pdu, at + 5), address))


class Turning:
    """Drive in motion. ``mute``: requests arrive, and every reply is lost. ``requests``: those that arrived."""

    def __init__(self, profile, mode, folder, limits, *, seed=0):
        self.trace = folder / "shaft.csv"
        self.profile = profile
        self.clock = SteppedClock()
        self.simulated = EmbeddedModbusDrive(RigParams(), profile, trace=self.trace, seed=seed)
        self.mute = False
        self.requests = []
        self.before = lambda: None
        self.link = EmbeddedLink(self.serve, self.clock)
        self.drive = drive = ModbusDrive(
            self.link, profile, unit=1, given=dict(self.simulated.untold),
            rated_torque_nm=None if profile.rated_torque else self.simulated.rated_torque_nm,
        )
        drive.connect()
        assert not drive.preflight(limits).refused
        drive.enable(Mode.SPEED)
        sample = None
        while sample is None or sample.speed_rad_s < 0.9 * FAST_RAD_S:
            assert self.clock.now_s() < 60.0
            sample = drive.exchange(Command(Mode.SPEED, FAST_RAD_S, 0.0))
        while mode is Mode.TORQUE and sample.mode is not Mode.TORQUE:
            sample = drive.exchange(Command(Mode.TORQUE, FAST_RAD_S, sample.torque_nm))
        self.command = Command(mode, FAST_RAD_S, 120.0)
        for _ in range(10):
            drive.exchange(self.command)
        self.cycle = [pdu for pdu in self.requests[-12:] if written(pdu)]
        self.requests.clear()

    def serve(self, unit, pdu, now_s):
        self.requests.append(pdu)
        self.before()
        reply, complete_s = self.simulated.serve(unit, pdu, now_s)
        return None if self.mute else reply, complete_s

    def control_words(self):
        """Return the control words that arrived."""
        address = self.profile.cycle.control.register_.address
        return [word for pdu in self.requests for at, word in written(pdu) if at == address]

    @property
    def quick_stop_word(self):
        control = self.profile.control
        return control.quick_stop | control.speed_bits

    def run_until(self, time_s):
        self.clock.wait_until(time_s)
        self.simulated.run_until(time_s)

    def rows(self):
        """Return the rows of the shaft's trace as [(time, speed, state)]."""
        self.simulated.close()
        with self.trace.open() as file:
            return [(float(row[0]), float(row[1]), row[3]) for row in list(csv.reader(file))[1:]]
