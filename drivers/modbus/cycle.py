"""One cycle's numbers: command → registers to write, registers read → feedback. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from drivers.drive import Command, Mode
from drivers.errors import CommandRejected
from drivers.modbus.codec import WordOrder, from_words, register_name, to_counts, to_words
from drivers.modbus.plan import Words
from drivers.modbus.scales import Scales
from profiles.modbus import ModbusProfile, Register


class Setpoints(NamedTuple):
    """A command in the drive's own counts. ``reverse``: the speed's sign, where its register has none."""

    speed: int
    torque: int | None
    reverse: bool


class Feedback(NamedTuple):
    """What a cycle read, in SI at the motor shaft. ``mode_word``: None where the display wasn't read along."""

    status: int
    speed_rad_s: float
    torque_nm: float
    torque_demand_nm: float | None
    mode_word: int | None


class Codec:
    """The cycle's registers with their scales."""

    def __init__(self, profile: ModbusProfile, scales: Scales, *, has_demand: bool) -> None:
        self._cycle = profile.cycle
        self._modes = profile.modes
        self._signless = profile.control.reverse_bits is not None
        self._order: WordOrder = profile.line.word_order
        self._has_demand = has_demand
        self.scales = scales

    def setpoints(self, command: Command) -> Setpoints:
        """The command's counts. Raises CommandRejected for what isn't finite or doesn't fit."""
        entry = self._cycle.speed_setpoint
        reverse = self._signless and command.speed_rad_s < 0.0
        speed_rad_s = -command.speed_rad_s if reverse else command.speed_rad_s
        where = f"speed setpoint, {register_name(entry.register_)}"
        speed = to_counts(speed_rad_s, self.scales.speed_setpoint, entry.register_, where)
        torque_entry = self._cycle.torque_setpoint
        if torque_entry is None or not self._modes.torque:
            if not math.isfinite(command.torque_nm):
                raise CommandRejected(f"{command.torque_nm} N·m is not finite", where="torque setpoint")
            return Setpoints(speed, None, reverse)
        where = f"torque setpoint, {register_name(torque_entry.register_)}"
        torque = to_counts(command.torque_nm, self.scales.torque_setpoint, torque_entry.register_, where)
        return Setpoints(speed, torque, reverse)

    def image(self, controlword: int, setpoints: Setpoints, mode: Mode) -> dict[int, int]:
        """Every register that a cycle may write, by its address.

        Where both setpoints share a register, the one of the mode that is asked for stands in it.
        """
        image: dict[int, int] = {}
        numbers: list[tuple[Register, int]] = [(self._cycle.speed_setpoint.register_, setpoints.speed)]
        if self._cycle.torque_setpoint is not None and setpoints.torque is not None:
            numbers.append((self._cycle.torque_setpoint.register_, setpoints.torque))
        if mode is Mode.SPEED:
            numbers.reverse()
        value = self._modes.torque_value if mode is Mode.TORQUE else self._modes.speed_value
        if self._modes.register_ is not None and value is not None:
            numbers.append((self._modes.register_, value))
        for register, number in numbers:
            words = to_words(number, register.type, self._order)
            image.update({register.address + k: word for k, word in enumerate(words)})
        image[self._cycle.control.register_.address] = controlword
        return image

    def feedback(self, words: Words) -> Feedback:
        """What was read. Raises KeyError if a register is missing."""
        demand = self._cycle.torque_demand if self._has_demand else None
        display = self._modes.display
        return Feedback(
            self._number(words, self._cycle.status.register_) & 0xFFFF,
            self._number(words, self._cycle.speed.register_) * self.scales.speed,
            self._number(words, self._cycle.torque.register_) * self.scales.torque,
            None if demand is None else self._number(words, demand.register_) * self.scales.torque_demand,
            words.get((display.register_.table, display.register_.address)) if display is not None else None,
        )

    def _number(self, words: Words, register: Register) -> int:
        own = [words[register.table, register.address + k] for k in range(register.count)]
        return from_words(own, register.type, self._order)


def shown_mode(profile: ModbusProfile, word: int) -> Mode | None:
    """The mode that the drive displays; None for another one, or where it doesn't tell."""
    display = profile.modes.display
    if display is None:
        return None
    shown: Mapping[int, Mode] = {display.torque: Mode.TORQUE, display.speed: Mode.SPEED}
    return shown.get(word & display.mask)
