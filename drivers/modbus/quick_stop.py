"""The bare quick stop of a Modbus drive (`drivers.quick_stop`): the profile's quick-stop word, repeated as needed.

If a quick stop does not decelerate from torque mode, the drive gets speed mode at zero speed first, as in a run; with
torque off the shaft would coast. Nothing else of the drive is set or checked. The speed is in rad/s if its scale can be
read, else in counts.
"""

from __future__ import annotations

import math
from contextlib import suppress

from drivers.drive import FrameTap, Mode, PowerState
from drivers.errors import CommunicationLost, PreflightRefused, TdhilError
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import si_per_count, to_words
from drivers.modbus.cycle import shown_mode
from drivers.modbus.link import Link
from drivers.modbus.pdu import RegisterRefused
from drivers.modbus.position import find_angle
from drivers.modbus.state_machine import decode, power_state, seen
from drivers.preflight import PreflightTable
from drivers.quick_stop import BLANK_WORDS, SLOWER, Seen
from drivers.standstill import PositionSource, StandstillTest
from profiles.modbus import ModbusProfile, StatusState

ANGLE_TIMEOUT_S = 0.1
"""Time for one reading of the position, s."""
MODE_S, MODE_UNTOLD_S = 1.0, 0.3
"""Longest time for the change to speed mode, s: with a mode display, and without."""
UNSLOWED_S = 3.0
"""Time without slowing down, s, after which a drive that is still enabled does not follow the quick stop. Many drives
show `enabled` during their own stop ramp. A ramp begins within this time, and falls by 1 % of the speed in it."""
_BRAKING = (PowerState.QUICK_STOP, PowerState.FAULT_REACTION, PowerState.READY)
_POWERED = (PowerState.ENABLED, *_BRAKING)
_LEFT_OPERATION = (PowerState.OFF, PowerState.FAULT, *_BRAKING)


class ModbusTarget:
    """One unit on an open line, for a bare quick stop."""

    def __init__(self, link: Link, profile: ModbusProfile, *, unit: int, tap: FrameTap | None = None) -> None:
        self._profile = profile
        self._access = RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions), tap)
        self._scale: float | None = None
        self._standstill: StandstillTest | None = None     # with the first reading
        self._stops = self._unheard = 0    # quick stops written; those of them without a reply to the reading before
        self._left_operation = self._enabled_again = self._unslowed = False
        self._least_speed, self._slower_s = math.inf, 0.0      # least magnitude, counts, and its control time
        self._reverse: bool | None = None
        self._switching_since_s: float | None = None
        self._stayed_in_torque = False

    def ask(self, attempt: int) -> None:
        """Write the quick-stop word under speed control, if there is power to brake with, or if no reply shows that.

        A line may lose the replies only, and reading alone may feed the drive's watchdog. Raises TdhilError.
        """
        failed: CommunicationLost | None = None
        try:
            if not self._is_due():
                return
        except CommunicationLost as error:
            failed = error
            self._unheard += 1
            self._write_speed_mode_once()
        if not self._stops:
            self._slower_s = self._access.clock.now_s()
        self._stops += 1
        word = self._profile.control.quick_stop | self._speed_bits(reads=failed is None)
        self._access.write(self._profile.cycle.control.register_, word)
        if failed is not None:
            raise failed

    def _is_due(self) -> bool:
        """Return whether to write the quick-stop word now."""
        status = self._access.read(self._profile.cycle.status.register_) & 0xFFFF
        state = decode(self._profile.control, status) if status else None      # zeros may come from a gateway
        if state is None:
            return True                # a drive in an unknown state may have power
        power = power_state(state)
        return power in _POWERED and (power is not PowerState.ENABLED or self._in_speed_mode(state))

    def _write_speed_mode_once(self) -> None:
        """Write a speed of zero and speed mode, if a quick stop needs it, without a reply.

        If bits of the control word select the mode, those of the quick-stop word do it.
        """
        cycle, modes = self._profile.cycle, self._profile.modes
        if not self._needs_speed_mode or modes.register_ is None or modes.speed_value is None:
            return
        for register, counts in ((cycle.speed_setpoint.register_, 0), (modes.register_, modes.speed_value)):
            with suppress(CommunicationLost, RegisterRefused):
                words = to_words(counts, register.type, self._profile.line.word_order)
                self._access.once(self._access.write_request(register.address, words), MODE_UNTOLD_S)

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
        modes = self._profile.modes
        if not self._needs_speed_mode:
            return True
        since_s = self._switching_since_s
        waited_s = 0.0 if since_s is None else self._access.clock.now_s() - since_s
        if modes.display is None:
            return since_s is not None and waited_s >= MODE_UNTOLD_S
        shown = shown_mode(self._profile, self._access.read(modes.display.register_) & 0xFFFF)
        self._stayed_in_torque = shown is not Mode.SPEED and waited_s > MODE_S
        return shown is Mode.SPEED or self._stayed_in_torque

    @property
    def _needs_speed_mode(self) -> bool:
        """Return whether a quick stop may need speed mode first."""
        modes, stop = self._profile.modes, self._profile.quick_stop
        return modes.torque and not stop.decelerates_in_torque_mode and modes.switch_while_enabled

    def _speed_bits(self, *, reads: bool = True) -> int:
        """Return the speed bits of the control word, with its direction bit if it has one. ``reads``: it may be
        read.
        """
        control = self._profile.control
        if reads and self._reverse is None and control.reverse_bits is not None:
            with suppress(PreflightRefused, CommunicationLost):
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
        self._compare(power, abs(raw), near=near)
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

    def _compare(self, power: PowerState, speed: int, *, near: bool) -> None:
        """Compare state and speed (counts) with earlier readings: another master enables or turns the drive again."""
        now_s = self._access.clock.now_s()
        self._left_operation = self._left_operation or power in _LEFT_OPERATION
        if not self._stops:
            return
        if power is PowerState.ENABLED and self._left_operation:
            self._enabled_again = True
        if power is not PowerState.ENABLED or near:
            self._slower_s = now_s
            return
        if speed < SLOWER * self._least_speed:
            self._least_speed, self._slower_s = speed, now_s
        self._unslowed = self._unslowed or now_s - self._slower_s > UNSLOWED_S

    def remarks(self) -> tuple[str, ...]:
        """Return remarks on the stop."""
        said = []
        if self._switching_since_s is not None:
            said.append("a quick stop does not decelerate from torque mode: tdhil requested speed mode at zero first")
        if self._stayed_in_torque:
            said.append(
                "the drive did not change to speed mode, and its quick stop may release the shaft in torque mode"
            )
        if self._unheard:
            said.append("the drive did not reply, so tdhil wrote the quick stop without knowing the drive's state")
        if self._enabled_again:
            said.append("the drive was enabled again after the quick stop: it follows another master. Stop that master"
                        " too")
        elif self._unslowed:
            said.append(f"the drive stayed enabled and did not slow down within {UNSLOWED_S:g} s: it still follows"
                        " another master, or ignores the quick stop. Stop that master too")
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
