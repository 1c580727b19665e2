"""ModbusDrive on the embedded simulator with the profile generic/modbus, over a line without delay, in stepped time.

Registers and formats are typed here by hand from the map in profiles/generic/modbus.yaml; neither codec is used.
"""

import struct

from drivers.clock import SteppedClock
from drivers.drive import Mode, PowerState
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from profiles.library import load_modbus_profile
from sim_bus.modbus.embedded import EmbeddedModbusDrive, LineTiming
from tests.drivers.drive_benches import LIMITS, RPM
from tests.rigs import QUIET_RIG


def driven(simulated, profile, clock=None):
    """Return a ModbusDrive on a simulated drive, with the values that no register of the profile contains."""
    return ModbusDrive(
        EmbeddedLink(simulated.serve, clock or SteppedClock()), profile, unit=simulated.unit,
        given=dict(simulated.untold), rated_torque_nm=None if profile.rated_torque else simulated.rated_torque_nm,
    )


class ModbusBench:
    """Bench with the interface of `drive_benches`."""

    SETTINGS = (36, 37, 38, 39, 40, 41)
    MAPPING = ()
    TARGETS = (4, 0, 1, 2, 3)
    WATCHDOG = 40
    LEAST_FRAMES = 3000            # one request and one reply per cycle
    OWN_IDENTIFIERS = False        # both directions contain the unit's number
    modes = frozenset({Mode.SPEED, Mode.TORQUE})
    ends = PowerState.QUICK_STOP
    ramp_rad_s2, ramp_rel = LIMITS.quick_stop_rad_s2, 0.05
    has_limits = True
    safe_action = "quick_stop"

    def __init__(self, params=QUIET_RIG, *, seed=0, timing=None, **options):
        self.limits = LIMITS
        self.rated_nm = 1000.0
        self.speed_lsb, self.torque_lsb = 0.01 * RPM, 1.0
        profile = load_modbus_profile("generic/modbus")
        self.simulated = EmbeddedModbusDrive(
            params, profile, seed=seed,
            timing=LineTiming() if timing is None else timing,
        )
        self.clock = SteppedClock()
        self._heard = []
        self.frames = []
        options.setdefault("rate_hz", 250.0)
        self._ask(struct.pack(">BHH", 6, 4, 1))           # an earlier user left it in torque mode
        self.drive = ModbusDrive(
            EmbeddedLink(self._serve, self.clock), profile, unit=1, tap=self.frames.append, **options
        )

    def _serve(self, unit, pdu, now_s):
        reply, complete_s = self.simulated.serve(unit, pdu, now_s)
        self._heard += [(unit, pdu)] + ([(unit, reply)] if reply is not None else [])
        return reply, complete_s

    def _ask(self, pdu):
        reply, _ = self.simulated.serve(1, pdu, self.clock.now_s())
        return reply

    @property
    def true_speed_rad_s(self):
        self.simulated.run_until(self.clock.now_s())
        return self.simulated.speed_rad_s

    def close(self):
        self.simulated.close()

    def heard(self):
        """Return all data on the line since the last call."""
        heard, self._heard = self._heard, []
        return heard

    def settings(self, keys=SETTINGS):
        """Return the registers by 'address:0', read by a station of the tests."""
        found = {}
        for address in keys:
            function, size, value = struct.unpack(">BBH", self._ask(struct.pack(">BHH", 3, address, 1)))
            assert (function, size) == (3, 2)
            found[f"{address:04X}h:0"] = value
        return found

    def decode(self, frames):
        """Decode the cycles, which are function 23. Preflight ends with the last write by another function."""
        found, cycle = [], False
        armed_s = max((one.time_s for one in frames if one.outgoing and one.data[0] in (6, 16)), default=-1.0)
        for frame in frames:
            if frame.time_s <= armed_s:
                continue
            if frame.outgoing:
                cycle = frame.data[0] == 23
            elif cycle:
                function, size, status, speed, torque, mode = struct.unpack(">BBHihH", frame.data)
                assert (function, size) == (23, 10)
                shown = {0: Mode.SPEED, 1: Mode.TORQUE}.get(mode)
                found.append((status, speed * 0.01 * RPM, torque * 1.0, None, shown))
        return found

    def setpoints(self, frames):
        found = []
        for frame in frames:
            if frame.outgoing and frame.data[0] == 23:
                head, _, speed, torque, _ = struct.unpack(">10sHihH", frame.data)
                assert head == bytes.fromhex("17 0010 0005 0000 0005 0a")
                found.append((speed * 0.01 * RPM, torque * 1.0))
        return found
