"""Cia402Drive over a dictionary of objects in memory: the second implementation of its contract, without a bus.

The drive inside is the simulator's. Its objects, their units and the cyclic frame are typed by hand here.
"""

import math
import struct

import numpy as np

from drivers.cia402.bus import Cia402Bus, CycleInputs
from drivers.cia402.drive import Cia402Drive
from drivers.cia402.objects import Objects, name
from drivers.cia402.supervision import DriveWatch, Group
from drivers.cia402.watchdog import arm
from drivers.clock import SteppedClock
from drivers.drive import Mode, PowerState, RawFrame
from drivers.errors import ObjectRefused
from profiles import MARKER_INDEX, MARKER_STAGE, MARKER_TEXT
from profiles.library import load_canopen_profile
from sim_bus.cia402 import Application
from sim_bus.inverter import Inverter
from tests.drivers.drive_benches import LIMITS
from tests.rigs import QUIET_RIG

RPM = math.pi / 30.0
LSB_RAD_S, LSB_NM = 0.1 * RPM, 1.0
WATCHDOG = (0x2100, 0)                 # ms; 0: off
MODES = (1 << 3 - 1) | (1 << 4 - 1) | (1 << 9 - 1) | (1 << 10 - 1)
SETPOINTS, FEEDBACK = struct.Struct("<Hhib"), struct.Struct("<Hhihb")


class MemoryDrive:
    """Drive as a dictionary of (index, sub-index): bytes, with hooks for objects with a function."""

    def __init__(self, params, seed):
        self.application = application = Application(Inverter(params, np.random.default_rng(seed)))
        self.silent_s, self.heard = 0.0, []
        settings, limits = application.settings, application.inverter.control.limits
        inverter, reporting = application.inverter, application.inverter.reporting
        numbers = {                    # object: (number, bytes)
            (0x1000, 0): (402, 4), (0x1018, 1): (1, 4), (0x1018, 2): (2, 4), (0x1018, 3): (3, 4), (0x1018, 4): (4, 4),
            (MARKER_INDEX, MARKER_STAGE): (0, 1), WATCHDOG: (0, 2), (0x6007, 0): (1, 2), (0x603F, 0): (0, 2),
            (0x605A, 0): (2, 2), (0x6072, 0): (1000, 2), (0x6076, 0): (1_000_000, 4), (0x6080, 0): (200, 4),
            (0x6085, 0): (300, 4), (0x6502, 0): (MODES, 4), (0x605E, 0): (2, 2),
        }
        self.data = {key: number.to_bytes(size, "little") for key, (number, size) in numbers.items()}
        self.data |= {(0x1008, 0): b"objects in memory", (MARKER_INDEX, 1): MARKER_TEXT.encode()}
        self.live = {
            (0x6040, 0): ("<H", lambda: application.controlword), (0x6041, 0): ("<H", application.statusword),
            (0x6060, 0): ("<b", lambda: application.mode.value), (0x6061, 0): ("<b", lambda: application.mode.value),
            (0x606C, 0): ("<i", lambda: round(reporting.speed_rad_s / LSB_RAD_S)),
            (0x6071, 0): ("<h", lambda: round(application.target_torque_nm / LSB_NM)),
            (0x6074, 0): ("<h", lambda: round(inverter.reported_demand_nm / LSB_NM)),
            (0x6077, 0): ("<h", lambda: round(reporting.torque_nm / LSB_NM)),
            (0x60FF, 0): ("<i", lambda: round(application.target_speed_rad_s / LSB_RAD_S)),
        }

        def torque_limit(counts):
            limits.torque_forward_nm = limits.torque_reverse_nm = counts * LSB_NM

        def put(target, field, unit=1):
            return lambda counts: setattr(target, field, counts * unit)

        self.acts = {
            (0x6007, 0): put(settings, "connection_option"), (0x605A, 0): put(settings, "quick_stop_option"),
            (0x6085, 0): put(settings, "quick_stop_rad_s2", LSB_RAD_S), (0x6072, 0): torque_limit,
            (0x6080, 0): put(limits, "speed_rad_s", RPM), (0x6040, 0): application.write_controlword,
            (0x6060, 0): application.set_mode, (0x6071, 0): put(application, "target_torque_nm", LSB_NM),
            (0x60FF, 0): put(application, "target_speed_rad_s", LSB_RAD_S),
        }

    def read(self, key):
        if key in self.live:
            layout, number = self.live[key]
            return struct.pack(layout, number())
        return self.data[key]

    def write(self, key, data):
        if key not in self.data and key not in self.acts:
            raise KeyError(key)
        if key in self.data:
            self.data[key] = data
        if key in self.acts:
            self.acts[key](int.from_bytes(data, "little", signed=key in self.live and key != (0x6040, 0)))

    def cycle(self, frame, period_s):
        """Take setpoints, return feedback, and advance the shaft by one period."""
        if frame is not None:
            word, torque, speed, mode = SETPOINTS.unpack(frame)
            for key, number in zip(((0x6060, 0), (0x6071, 0), (0x60FF, 0), (0x6040, 0)), (mode, torque, speed, word),
                                   strict=True):
                self.acts[key](number)
        found = [self.live[index, 0][1]() for index in (0x6041, 0x6077, 0x606C, 0x6074, 0x6061)]
        self.application.regulate()
        count, dt_s = self.application.inverter.steps(period_s)
        for _ in range(count):
            self.application.step(dt_s)
        self.silent_s += period_s
        if 0 < int.from_bytes(self.data[WATCHDOG], "little") < 1000.0 * self.silent_s:
            self.application.abort_connection()
        self.heard += ([] if frame is None else [(0, frame)]) + [(0, FEEDBACK.pack(*found))]
        return self.heard[-1][1]


class MemoryObjects(Objects):
    def __init__(self, drive):
        super().__init__()
        self._drive = drive

    def read_bytes(self, index, subindex=0):
        try:
            return self._drive.read((index, subindex))
        except KeyError:
            raise ObjectRefused("no such object", where=name(index, subindex)) from None

    def write_bytes(self, index, subindex, data, shown=""):
        try:
            self._drive.write((index, subindex), data)
        except KeyError:
            raise ObjectRefused("no such object", where=name(index, subindex)) from None


class MemoryBus(Cia402Bus):
    def __init__(self, drive, profile, clock, period_s, tap):
        super().__init__(MemoryObjects(drive), DriveWatch("memory", clock), clock, period_s)
        self._drive, self._profile, self._tap = drive, profile, tap
        self._frame, self._enabled, self._fed = None, True, True

    def take(self):
        pass

    def map_cyclic(self, table, content, demand, position):
        return ()

    def arm(self, table, limits):
        def armed(tried, time_ms):
            back = self.objects.change(*WATCHDOG, time_ms, 16)
            tried.row("watchdog", f"{time_ms} ms", f"{back} ms", back == time_ms, name(*WATCHDOG))
            self.feed()
            return self.period_s

        return arm(table, self.objects, self._profile.watchdog, armed, lambda: not self.objects.read(*WATCHDOG),
                   watchdog_s=limits.watchdog_s, period_s=self.period_s, accept_none=limits.accept_no_watchdog)

    def setting(self, index):
        return ("the drive's watchdog", Group.SAFETY) if index == WATCHDOG[0] else None

    def start(self):
        self.watch.start(0.0)

    def listen_until(self, tick_s):
        self.clock.wait_until(tick_s)

    def begin(self, try_again):
        self.watch.check()
        self.feed()
        return self.clock.now_s()

    def send(self, setpoints):
        self._frame = SETPOINTS.pack(setpoints.word, setpoints.torque, setpoints.speed, setpoints.mode)
        self._tap(RawFrame(self.clock.now_s(), True, 0, self._frame))

    def receive(self, now_s, sync):
        frame, self._frame = self._frame, None
        data = self._drive.cycle(frame if self._enabled else None, self.period_s)
        self._tap(RawFrame(now_s, False, 0, data))
        status, torque, speed, demand, mode = FEEDBACK.unpack(data)
        self.reported.take_slow(now_s, mode, demand)
        return CycleInputs(0.0, True, False, status, torque, speed)

    def feed(self):
        self._drive.silent_s = self._drive.silent_s if not self._fed else 0.0

    def stop_feeding(self):
        self._fed = False

    def disable_setpoints(self):
        self._enabled = False
        return 1

    def close(self):
        self._enabled = False


class MemoryBench:
    """Bench with the interface of `drive_benches`."""

    SETTINGS = (WATCHDOG, (0x6007, 0), (0x605A, 0), (0x6072, 0), (0x6080, 0), (0x6085, 0))
    TARGETS, MAPPING = ((0x6060, 0), (0x6071, 0), (0x60FF, 0)), ()
    WATCHDOG, LEAST_FRAMES, OWN_IDENTIFIERS = WATCHDOG, 3000, False
    modes, ends, safe_action = frozenset({Mode.SPEED, Mode.TORQUE}), PowerState.QUICK_STOP, "quick_stop"
    limits, rated_nm, has_limits = LIMITS, 1000.0, True
    speed_lsb, torque_lsb, ramp_rad_s2, ramp_rel = LSB_RAD_S, LSB_NM, LIMITS.quick_stop_rad_s2, 0.05

    def __init__(self, params=QUIET_RIG, *, seed=0, rate_hz=250.0):
        self.memory = MemoryDrive(params, seed)
        profile, self.frames = load_canopen_profile("generic/cia402"), []
        bus = MemoryBus(self.memory, profile, SteppedClock(), 1.0 / rate_hz, self.frames.append)
        self.drive = Cia402Drive(bus, profile, fixed_rate=True)

    @property
    def true_speed_rad_s(self):
        return self.memory.application.inverter.speed_rad_s

    def close(self):
        pass

    def heard(self):
        heard, self.memory.heard = self.memory.heard, []
        return heard

    def settings(self, keys=SETTINGS):
        return {f"{index:04X}h:{sub}": int.from_bytes(self.memory.read((index, sub)), "little") for index, sub in keys}

    def decode(self, frames):
        shown = {9: Mode.SPEED, 10: Mode.TORQUE}
        found = [FEEDBACK.unpack(frame.data) for frame in frames if not frame.outgoing]
        return [(status, speed * LSB_RAD_S, torque * LSB_NM, demand * LSB_NM, shown.get(mode))
                for status, torque, speed, demand, mode in found]

    def setpoints(self, frames):
        found = [SETPOINTS.unpack(frame.data) for frame in frames if frame.outgoing]
        return [(speed * LSB_RAD_S, torque * LSB_NM) for _, torque, speed, _ in found]
