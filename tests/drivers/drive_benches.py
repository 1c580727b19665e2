"""One bench for each kind of drive of the contract tests: the drive, and independent access to the other side.

A bench has ``drive`` (not yet connected), ``frames`` (all frames of its tap), ``limits``, ``true_speed_rad_s``, and

- ``settings()``: values in the drive, read by a client of the tests;
- ``decode(frames)``: the feedback in the tapped frames as [(status, speed, torque, demand, mode)], one per cycle;
- ``setpoints(frames)``: the setpoints in the frames as [(speed, torque)];
- ``modes``; ``ends``: state of the drive after a quick stop with a ramp of ``ramp_rad_s2``;
- ``heard()``: frames that another station received, as [(identifier, data)]; ``LEAST_FRAMES`` in 1,500 cycles.
"""

import math
import struct
from collections import deque
from contextlib import ExitStack, contextmanager

import can

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, PowerState
from profiles.library import load_canopen_profile
from sim_bus.canopen.inline import InlineSimulator
from tests.rigs import QUIET_RIG

LIMITS = DriveLimits(
    speed_rad_s=15.0, torque_nm=300.0, quick_stop_rad_s2=1.0, watchdog_s=0.5, accept_wider=frozenset({"quick-stop"})
)
RPM = math.pi / 30.0


class TamperedBus:
    """python-can bus between driver and wire that drops, delays and inserts frames to the driver."""

    def __init__(self, bus):
        self._bus = bus
        self.channel_info = bus.channel_info
        self.answers_at_once = getattr(bus, "answers_at_once", False)
        self.coming = deque()
        self.change = lambda message: [message]       # replacement of a frame
        self.on_sync = lambda: None
        self.send_error = self.receive_error = None

    def put(self, identifier, data):
        self.coming.append(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def send(self, message):
        if self.send_error is not None:
            raise self.send_error
        self._bus.send(message)
        if message.arbitration_id == 0x080:
            self.on_sync()

    def recv(self, timeout):
        if self.receive_error is not None:
            raise self.receive_error
        if self.coming:
            return self.coming.popleft()
        message = self._bus.recv(timeout)
        if message is None:
            return None
        self.coming.extend(self.change(message))
        return self.recv(0.0)

    def shutdown(self):
        self._bus.shutdown()


class CanopenBench:
    """CanopenDrive on the embedded simulator, stepped, in this thread."""

    SETTINGS = ((0x1006, 0), (0x1016, 1), (0x1017, 0), (0x6007, 0), (0x605A, 0), (0x6072, 0), (0x6080, 0), (0x6085, 0),
                (0x60C2, 1), (0x60C2, 2))
    TARGETS = ((0x6060, 0), (0x6071, 0), (0x60FF, 0))
    MAPPING = tuple(
        (index + number, sub)
        for number in range(2) for index, subs in ((0x1400, (1, 2)), (0x1600, range(5)), (0x1800, (1, 2)),
                                                   (0x1A00, range(5))) for sub in subs
    )
    WATCHDOG = (0x1016, 1)
    LEAST_FRAMES = 4000
    OWN_IDENTIFIERS = True         # the identifier shows the direction of a frame

    PROFILE, WORN = "generic/cia402", False
    modes = frozenset({Mode.SPEED, Mode.TORQUE})
    ends = PowerState.QUICK_STOP
    speed_lsb, torque_lsb = 0.1 * RPM, 1.0
    ramp_rad_s2 = LIMITS.quick_stop_rad_s2
    ramp_rel = 0.05
    has_limits = True              # settings that a run can change
    safe_action = "quick_stop"

    def __init__(self, params=QUIET_RIG, *, seed=0, **options):
        self.limits = LIMITS
        self.rated_nm = 1000.0
        profile = load_canopen_profile(self.PROFILE)
        self.simulated = InlineSimulator(
            params, seed=seed, profile=profile if self.WORN else None
        ).open()
        self._second = self.simulated.station()
        self.bus = TamperedBus(self.simulated.station())
        self.frames = []
        self.drive = CanopenDrive(self.bus, profile, SteppedClock(), node=1, tap=self._tap, **options)

    def _tap(self, frame):
        self.frames.append(frame)

    @property
    def true_speed_rad_s(self):
        return self.simulated.simulator.speed_rad_s

    def close(self):
        self._second.shutdown()
        self.bus.shutdown()
        self.simulated.close()

    def foreign(self, identifier, data):
        """Send a foreign frame on the bus."""
        self._second.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def heard(self):
        """Return all frames that the second station has received since the last call.

        Requests of a host on a busy computer (6FEh, 03h or 04h and a number) are left out: they are no part of
        the run.
        """
        frames = []
        while (message := self._second.recv(0.0)) is not None:
            if message.arbitration_id != 0x6FE:
                frames.append((message.arbitration_id, bytes(message.data)))
        return frames

    def read(self, index, sub=0):
        self.heard()
        self.foreign(0x601, struct.pack("<BHB4x", 0x40, index, sub))
        while (message := self._second.recv(2.0)) is not None:
            data = bytes(message.data)
            if message.arbitration_id == 0x581 and data[1:4] == struct.pack("<HB", index, sub):
                assert data[0] & 0xE3 == 0x43, data.hex()
                return int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little")
        raise AssertionError("the simulated drive does not answer")

    def settings(self, keys=None):
        keys = self.SETTINGS if keys is None else keys
        return {f"{index:04X}h:{sub}": self.read(index, sub) for index, sub in keys}

    def decode(self, frames):
        found, mode, demand = [], 0, None
        for frame in frames:
            if frame.outgoing:
                continue
            if frame.identifier == 0x281:
                mode, demand, _ = struct.unpack("<bhi", frame.data)
            elif frame.identifier == 0x181:
                status, torque, speed = struct.unpack("<Hhi", frame.data)
                shown = {9: Mode.SPEED, 3: Mode.SPEED, 10: Mode.TORQUE, 4: Mode.TORQUE}.get(mode)
                found.append((
                    status, speed * 0.1 * RPM, torque * 1.0, None if demand is None else demand * 1.0, shown,
                ))
        return found

    def setpoints(self, frames):
        words = [struct.unpack("<Hhi", frame.data) for frame in frames if frame.outgoing and frame.identifier == 0x201]
        return [(speed * 0.1 * RPM, torque * 1.0) for _, torque, speed in words]


@contextmanager
def opened():
    """Yield a function that makes benches of a kind, which are closed afterwards."""
    with ExitStack() as stack:
        def make(kind, *arguments, **options):
            bench = kind(*arguments, **options)
            stack.callback(bench.close)
            return bench

        yield make


class Run:
    """Sequence of contract calls on a bench that keeps every sample."""

    def __init__(self, bench):
        self.bench, self.drive = bench, bench.drive
        self.samples = []

    def ready(self):
        self.drive.connect()
        found = self.drive.preflight(self.bench.limits)
        assert found.refused == ()
        return found

    def cycle(self, mode=Mode.SPEED, speed=0.0, torque=0.0):
        sample = self.drive.exchange(Command(mode, speed, torque))
        self.samples.append(sample)
        return sample

    def go(self, duration_s, mode=Mode.SPEED, speed=0.0, torque=0.0):
        """Run cycles for a time and return the last sample."""
        for _ in range(round(duration_s / self.drive.period_s)):
            self.cycle(mode, speed, torque)
        return self.samples[-1]

    def until(self, wanted, within_s, mode=Mode.SPEED, speed=0.0, torque=0.0):
        """Run cycles until a sample meets the condition, and return it."""
        for _ in range(round(within_s / self.drive.period_s)):
            if wanted(self.cycle(mode, speed, torque)):
                return self.samples[-1]
        raise AssertionError(f"not within {within_s} s; last: {self.samples[-1]}")

    def enable(self, mode=Mode.SPEED):
        self.drive.enable(mode)
        return self.until(lambda sample: sample.state is PowerState.ENABLED and sample.mode is mode, 1.0, mode)

    def turning(self, speed=5.0, for_s=6.0):
        self.ready()
        self.enable()
        return self.go(for_s, speed=speed)

    def rests(self, sample):
        """Return whether the drive reports standstill or is disabled. Some drives disable themselves at standstill."""
        off = self.bench.ends is PowerState.OFF and sample.state is PowerState.OFF
        return sample.standstill or off

    def stop(self):
        if not getattr(self.bench, "brakes_in_torque_mode", True):      # as a run does it
            self.until(lambda sample: sample.mode is Mode.SPEED, 1.0)
        self.drive.quick_stop()
        self.until(self.rests, 30.0)
        self.drive.disable()
        self.until(lambda sample: sample.state is PowerState.OFF, 1.0)
