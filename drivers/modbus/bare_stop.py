"""The bare quick stop of a Modbus drive (`drivers.bare_stop`): the profile's quick-stop word, again while it follows.

Nothing of the drive is set or checked. The speed is told in rad/s where its scale can be read, else in counts.
"""

from __future__ import annotations

from drivers.bare_stop import Seen
from drivers.drive import FrameTap, PowerState
from drivers.errors import TdhilError
from drivers.modbus.access import Access
from drivers.modbus.link import Link
from drivers.modbus.scales import si_per_count
from drivers.modbus.states import decode, power_state, seen
from profiles.modbus_schema import ModbusProfile

NEAR_ZERO_RAD_S, NEAR_ZERO_COUNTS = 0.05, 5
NEAR_ZERO_SHARE = 0.005
"""Of the first speed that was seen, where its unit isn't known."""
_POWERED = (PowerState.ENABLED, PowerState.QUICK_STOP, PowerState.READY)


class ModbusTarget:
    """One unit on an open line."""

    def __init__(self, link: Link, profile: ModbusProfile, *, unit: int, tap: FrameTap | None = None) -> None:
        self._profile = profile
        self._access = Access(link, unit, profile.line.word_order, frozenset(profile.cycle.functions), tap)
        self._scale: float | None = None
        self._looked_for_scale = False
        self._first = 0
        self._driven = False

    def ask(self, attempt: int) -> None:
        """The quick-stop word under speed control, where there is power to brake with. Raises TdhilError."""
        control = self._profile.control
        state = decode(control, self._access.read(self._profile.cycle.status.register_) & 0xFFFF)
        if power_state(state) in _POWERED:
            self._driven = self._driven or (attempt > 2 and power_state(state) is PowerState.ENABLED)
            self._access.write(self._profile.cycle.control.register_, control.quick_stop | control.speed_bits)

    def look(self) -> Seen:
        """Status word and speed."""
        cycle, control = self._profile.cycle, self._profile.control
        status = self._access.read(cycle.status.register_) & 0xFFFF
        raw = self._access.read(cycle.speed.register_)
        if not self._looked_for_scale:
            self._looked_for_scale, self._first = True, abs(raw)
            self._scale = self._find_scale()
        power = power_state(decode(control, status))
        near = abs(raw) <= max(NEAR_ZERO_COUNTS, NEAR_ZERO_SHARE * self._first)
        if self._scale is not None:
            near = abs(raw) <= 3 or abs(raw * self._scale) <= NEAR_ZERO_RAD_S
        return Seen(
            state=power,
            text=f"{power.value} (status word {status:04X}h)",
            speed=float(raw) if self._scale is None else raw * self._scale,
            unit="counts" if self._scale is None else "rad/s",
            near_zero=near,
            standstill=seen(control.standstill, status),
            follows=power is PowerState.ENABLED,
        )

    def remarks(self) -> tuple[str, ...]:
        """What to know."""
        if self._driven:
            return ("the drive went on following somebody: another master is there; stop it too",)
        return ()

    def _find_scale(self) -> float | None:
        signal = self._profile.cycle.speed
        values = {}
        try:
            for parameter in self._profile.parameters:
                if parameter.name == signal.times and parameter.register_ is not None and parameter.times is None:
                    values[parameter.name] = self._access.read(parameter.register_) * parameter.per_lsb
            return si_per_count(signal, values, 1.0) or None
        except (KeyError, TdhilError):
            return None
