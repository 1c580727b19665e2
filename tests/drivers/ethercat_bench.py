"""EthercatDrive over the fake of pysoem; see `drive_benches` for what a bench offers."""

import struct

from drivers.clock import SteppedClock
from drivers.drive import Mode, PowerState
from drivers.ethercat.drive import EthercatDrive
from drivers.ethercat.segment import EthercatSegment
from profiles.library import load_profile
from tests.drivers.drive_benches import LIMITS
from tests.drivers.fake_soem import LSB_NM, LSB_RAD_S, FakeMaster, FakeSlave
from tests.rigs import QUIET_RIG

WATCHDOG = "0420h"
# 6041h 6077h 606Ch 6061h 6074h; 6040h 6071h 60FFh 6060h
FEEDBACK, SETPOINTS = struct.Struct("<Hhibh"), struct.Struct("<Hhib")


class EthercatBench:
    """One simulated drive behind a faked slave controller, stepped."""

    SETTINGS = (WATCHDOG, (0x60C2, 1), (0x60C2, 2), (0x6007, 0), (0x605A, 0), (0x6072, 0), (0x6080, 0), (0x6085, 0))
    TARGETS = ((0x6060, 0), (0x6071, 0), (0x60FF, 0))
    MAPPING = ((0x1C12, 0), (0x1C12, 1), (0x1C13, 0), (0x1C13, 1), *((0x1600, sub) for sub in range(5)),
               *((0x1A00, sub) for sub in range(6)))
    WATCHDOG, LEAST_FRAMES, OWN_IDENTIFIERS = WATCHDOG, 3000, False
    modes, ends, safe_action = frozenset({Mode.SPEED, Mode.TORQUE}), PowerState.QUICK_STOP, "quick_stop"
    limits, rated_nm, has_limits = LIMITS, 1000.0, True
    speed_lsb, torque_lsb, ramp_rad_s2, ramp_rel = LSB_RAD_S, LSB_NM, LIMITS.quick_stop_rad_s2, 0.05

    def __init__(self, params=QUIET_RIG, *, seed=0, clock=None, clocks=False, **options):
        self.slave = FakeSlave(params, seed, clocks=clocks)
        self.slave.man, self.slave.id = 4, 4
        self.slave.drive.data[0x1018, 1] = self.slave.drive.data[0x1018, 2] = (4).to_bytes(4, "little")
        self.master, self.frames = FakeMaster(self.slave), []
        self.segment = EthercatSegment(self.master, "fake0")
        self.drive = EthercatDrive(
            self.segment, load_profile("generic/cia402-ethercat"), clock or SteppedClock(), tap=self.frames.append,
            **options,
        )

    @property
    def true_speed_rad_s(self):
        return self.slave.application.inverter.speed_rad_s

    def close(self):
        pass

    def heard(self):
        heard, self.slave.heard = self.slave.heard, []
        return heard

    def settings(self, keys=SETTINGS):
        data = self.slave.drive
        return {WATCHDOG if key == WATCHDOG else f"{key[0]:04X}h:{key[1]}":
                self.slave.number(0x0420) if key == WATCHDOG else int.from_bytes(data.read(key), "little")
                for key in keys}

    def decode(self, frames):
        shown = {9: Mode.SPEED, 10: Mode.TORQUE}
        # The frames before the first cycle bring the slave to OP and are no cycles.
        found = [FEEDBACK.unpack(one.data) for one in frames if one.identifier == 3 and one.time_s > 0.0]
        return [(status, speed * LSB_RAD_S, torque * LSB_NM, demand * LSB_NM, shown.get(mode))
                for status, torque, speed, mode, demand in found]

    def setpoints(self, frames):
        found = [SETPOINTS.unpack(one.data) for one in frames if one.identifier == 2]
        return [(speed * LSB_RAD_S, torque * LSB_NM) for _, torque, speed, _ in found]
