"""The bare quick stop of a Modbus drive (`drivers.quick_stop`): the profile's quick-stop word, repeated as needed.

If a quick stop does not decelerate from torque mode, the drive gets speed mode at zero speed first, as in a run; with
torque off the shaft would coast. Nothing else of the drive is set or checked. The speed is in rad/s if its scale can be
read, else in counts.
"""

from __future__ import annotations

from contextlib import suppress

from drivers.drive import FrameTap, Mode, PowerState
from drivers.errors import PreflightRefused, TdhilError
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import si_per_count
from drivers.modbus.cycle import shown_mode
from drivers.modbus.link import Link
from drivers.modbus.pdu import RegisterRefused
from drivers.modbus.position import find_angle
from drivers.modbus.state_machine import decode, power_state, seen
from drivers.preflight import PreflightTable
from drivers.quick_stop import BLANK_WORDS, Seen
from drivers.standstill import PositionSource, StandstillTest
from profiles.modbus import ModbusProfile, StatusState

ANGLE_TIMEOUT_S = 0.1
"""Time for one reading of the position, s."""
MODE_S, MODE_UNTOLD_S = 1.0, 0.3
"""Longest time for the change to speed mode, s: with a mode display, and without."""
_BRAKING = (PowerState.QUICK_STOP, PowerState.FAULT_REACTION, PowerState.READY)
_POWERED = (PowerState.ENABLED, *_BRAKING)


class ModbusTarget:
    """One unit on an open line, for a bare quick stop."""

    def __init__(self, link: Link, profile: ModbusProfile, *, unit: int, tap: FrameTap | None = None) -> None:
        self._profile = profile
        self._access = RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions), tap)
        self._scale: float | None = None
        self._standstill: StandstillTest | None = None     # with the first reading
        self._driven = False
        self._stops = 0
        self._reverse: bool | None = None
        self._switching_since_s: float | None = None
        self._stayed_in_torque = False

    def ask(self, attempt: int) -> None:
        """Write the quick-stop word under speed control, if there is power to brake with. Raises TdhilError."""
        control = self._profile.control
        status = self._access.read(self._profile.cycle.status.register_) & 0xFFFF
        state = decode(control, status) if status else None        # zeros may come from a gateway
        power = power_state(state)
        if state is not None and power not in _POWERED:
            return                     # no power; a drive in an unknown state may have power
        if power is PowerState.ENABLED and state is not None and not self._in_speed_mode(state):
            return
        self._stops += 1
        self._driven = self._driven or (self._stops > 2 and power is PowerState.ENABLED)
        self._access.write(self._profile.cycle.control.register_, control.quick_stop | self._speed_bits())

    def _in_speed_mode(self, state: StatusState) -> bool:
        """Return whether to send the quick stop now. Otherwise speed mode was requested; a refusal gets `MODE_S` of
        time.
        """
        try:
            if self._stop_would_brake():
                return True
            cycle, modes = self._profile.cycle, self._profile.modes
            if self._switching_since_s is None:
                self._switching_since_s = self._access.clock.now_s()
            # Setpoints of zero, then the mode, in its register or by bits of an enabling control word.
            self._access.write(cycle.speed_setpoint.register_, 0)
            if modes.register_ is not None and modes.speed_value is not None:
                self._access.write(modes.register_, modes.speed_value)
            if state.onward is not None:
                self._access.write(cycle.control.register_, state.onward | self._speed_bits())
            return self._stop_would_brake()
        except RegisterRefused:
            now_s, since_s = self._access.clock.now_s(), self._switching_since_s
            self._switching_since_s = now_s if since_s is None else since_s
            if now_s - self._switching_since_s <= MODE_S:
                raise
            self._stayed_in_torque = True
            return True

    def _stop_would_brake(self) -> bool:
        """Return whether a quick stop brakes now: in speed mode, without need of a switch, or after an unconfirmed
        switch.
        """
        modes, stop = self._profile.modes, self._profile.quick_stop
        if not modes.torque or stop.decelerates_in_torque_mode or not modes.switch_while_enabled:
            return True
        since_s = self._switching_since_s
        waited_s = 0.0 if since_s is None else self._access.clock.now_s() - since_s
        if modes.display is None:
            return since_s is not None and waited_s >= MODE_UNTOLD_S
        shown = shown_mode(self._profile, self._access.read(modes.display.register_) & 0xFFFF)
        self._stayed_in_torque = shown is not Mode.SPEED and waited_s > MODE_S
        return shown is Mode.SPEED or self._stayed_in_torque

    def _speed_bits(self) -> int:
        """Return the speed bits of the control word, with its direction bit if it has one."""
        control = self._profile.control
        if self._reverse is None and control.reverse_bits is not None:
            with suppress(PreflightRefused):
                word = self._access.read(self._profile.cycle.control.register_) & 0xFFFF
                self._reverse = bool(word & control.reverse_bits)
        return control.speed_bits | ((control.reverse_bits or 0) if self._reverse else 0)

    def poll(self) -> Seen:
        """Read status word and speed.

        While the shaft turns under power the quick-stop word is repeated: the drive's watchdog may release the shaft,
        and no other master may be feeding it.
        """
        cycle, control = self._profile.cycle, self._profile.control
        status = self._access.read(cycle.status.register_) & 0xFFFF
        raw = self._access.read(cycle.speed.register_)
        if self._standstill is None:
            self._scale = self._find_scale()
            self._standstill = StandstillTest(self._scale, self._find_position)
        power = power_state(decode(control, status))
        near = self._standstill.near_zero(raw)
        if not near and self._stops and power in _BRAKING:
            self._access.write(cycle.control.register_, control.quick_stop | self._speed_bits())
        return Seen(
            state=power,
            text=f"{power.value} (status word {status:04X}h)",
            speed=float(raw) if self._scale is None else raw * self._scale,
            unit="counts" if self._scale is None else "rad/s",
            near_zero=near,
            standstill=seen(control.standstill, status),
            follows=power is PowerState.ENABLED,
            blank=status in BLANK_WORDS,
        )

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on the stop."""
        said = []
        if self._switching_since_s is not None:
            said.append("a quick stop does not decelerate from torque mode: tdhil requested speed mode at zero first")
        if self._stayed_in_torque:
            said.append(
                "the drive did not change to speed mode, and its quick stop may release the shaft in torque mode"
            )
        if self._driven:
            said.append("the drive still follows another master. Stop that master too")
        return (*said, *(() if self._standstill is None else self._standstill.remarks()))

    def _find_position(self) -> PositionSource | None:
        angle = find_angle(PreflightTable(), self._access, self._profile)
        if angle is None:
            return None
        return PositionSource(angle.rad_per_count, lambda: angle.read(self._access, ANGLE_TIMEOUT_S))

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
