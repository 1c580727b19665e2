"""Benches of CANopen profiles of real drives: the simulated drive uses them. Frames are decoded by hand."""

import struct

from drivers.drive import Mode, PowerState, RawFrame
from tests.drivers.drive_benches import RPM, CanopenBench

REMOTE = 1 << 30
"""Flag in the identifier of a remote frame, as in SocketCAN. The reply of the drive has the identifier without it."""


class ProfileBench(CanopenBench):
    """Mode in TPDO2; status, torque and speed in TPDO1, as ``FEEDBACK`` has them."""

    FEEDBACK = "<Hhi"
    MODES = ()                     # displayed value: mode

    def decode(self, frames):
        found, mode, shown = [], 0, dict(self.MODES)
        for frame in frames:
            if not frame.outgoing and frame.identifier == 0x281:
                mode, _ = struct.unpack("<bi", frame.data)
            elif not frame.outgoing and frame.identifier == 0x181:
                status, torque, speed = struct.unpack(self.FEEDBACK, frame.data)
                found.append((status, speed * self.speed_lsb, torque * self.torque_lsb, None, shown.get(mode)))
        return found


class Epos4Bench(ProfileBench):
    """Bench with rpm, thousandths of a rated torque in µN·m, no 6074h, and a torque limit by current."""

    PROFILE, WORN = "maxon/epos4", True
    SETTINGS = ((0x1016, 1), (0x1017, 0), (0x6007, 0), (0x605A, 0), (0x3001, 2), (0x6080, 0), (0x6085, 0), (0x60C2, 1))
    MODES = ((9, Mode.SPEED), (10, Mode.TORQUE))
    speed_lsb, torque_lsb = RPM, 1.0
    brakes_in_torque_mode = False  # its quick stop coasts in torque mode: `Preflight.quick_stop_in_torque_mode`
    ramp_rad_s2 = 10.0 * RPM       # 1 rad/s² is 9.55 rpm/s, the next one up

    def setpoints(self, frames):
        words = [struct.unpack("<Hhi", frame.data) for frame in frames if frame.outgoing and frame.identifier == 0x201]
        return [(rpm * RPM, torque * 1.0) for _, torque, rpm in words]


class S120Bench(ProfileBench):
    """Bench with encoder increments per second (2048 pulses x 2^11), 5810h (4000h = 1000 N·m), and node guarding."""

    PROFILE, WORN = "siemens/s120-canopen", True
    SETTINGS = ((0x100C, 0), (0x100D, 0), (0x1017, 0), (0x6007, 0), (0x6072, 0), (0x25F1, 0), (0x243A, 0), (0x246F, 0))
    TARGETS = ((0x6060, 0), (0x60FF, 0))
    WATCHDOG = (0x100C, 0)
    LEAST_FRAMES = 1600            # at 100 Hz
    modes = frozenset({Mode.SPEED})
    ends = PowerState.OFF
    MODES = ((3, Mode.SPEED),)
    speed_lsb, torque_lsb = 60.0 * RPM / 4194304, 1000.0 / 16384

    def _tap(self, frame):
        if frame.outgoing and frame.identifier == 0x701:
            frame = RawFrame(frame.time_s, True, REMOTE | 0x701, frame.data)
        self.frames.append(frame)

    def heard(self):
        frames = []
        while (message := self._second.recv(0.0)) is not None:
            identifier = message.arbitration_id | (REMOTE if message.is_remote_frame else 0)
            frames.append((identifier, bytes(message.data)))
        return frames

    def setpoints(self, frames):
        words = [struct.unpack("<Hi", frame.data) for frame in frames if frame.outgoing and frame.identifier == 0x201]
        return [(counts * self.speed_lsb, None) for _, counts in words]


class AbbBench(ProfileBench):
    """Bench in velocity mode: 6042h and 6044h in rpm, 16 bits; torque in thousandths, no adjustable limit or ramp."""

    PROFILE, WORN = "abb/acs880-fcan", True
    SETTINGS = ((0x1016, 1), (0x1017, 0))
    TARGETS = ((0x6060, 0), (0x6042, 0))
    LEAST_FRAMES = 1600            # at 100 Hz
    modes = frozenset({Mode.SPEED})
    ends = PowerState.OFF
    FEEDBACK, MODES = "<Hhh", ((2, Mode.SPEED),)
    speed_lsb, torque_lsb = RPM, 1.0
    has_limits = False
    ramp_rad_s2, ramp_rel = 3.0, 0.12      # ramp of the simulated drive, too steep for its speed loop
    safe_action = "coast"

    def __init__(self, *args, **options):
        super().__init__(*args, rated_torque_nm=1000.0, **options)

    def setpoints(self, frames):
        words = [struct.unpack("<Hh", frame.data) for frame in frames if frame.outgoing and frame.identifier == 0x201]
        return [(rpm * RPM, None) for _, rpm in words]
