"""Detection of another master that writes to the drive during a run: foreign words, and changed settings.

From time to time, just before a cycle writes, the registers that the cycle writes are read. Control word and setpoints
must be values that this host has sent within the last half second (an adapter's process image may lag). A register
counts once it has returned a number other than zero, because some drives do not show their words. In between, the
settings of the run (watchdog and reaction, limits, requirements of preflight, scales of the signals) must be unchanged.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

from drivers.errors import CommunicationLost
from drivers.modbus import pdu
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import from_words, per_count, register_name, si_per_count
from drivers.modbus.cycle import CyclePlan, RegisterSpan, spans
from drivers.modbus.parameters import show
from drivers.modbus.pdu import LinkLost, RegisterRefused
from profiles import MessageCode
from profiles.modbus import CyclicSignal, ModbusProfile, Parameter, Register

REMEMBERED_S = 0.5
EVERY_S, EVERY_TIGHT_S = 0.1, 0.5
"""Mean interval between two checks, s: with room on the line, and without."""
SETTINGS_EVERY, SETTINGS_EVERY_TIGHT = 8, 2
"""One of this number of checks reads the settings."""
GOLDEN = 0.6180339887498949
"""Golden ratio: it spreads the checks, so that they never stay in step with another master's writes."""
ROOM = 0.8
"""Share of the period that a cycle with a check may take."""
_TAKE_OFF = "Disconnect the other master (PLC, panel, commissioning tool, gateway)"


class _WrittenRegister(NamedTuple):
    """One register that the cycle writes."""

    name: str
    register: Register
    shown: Callable[[int], str]


class OtherMaster:
    """Records what this host has sent and the settings; `poll` must be called before a cycle writes."""

    def __init__(self, access: RegisterAccess, profile: ModbusProfile, plan: CyclePlan) -> None:
        self._access = access
        self._profile = profile
        self._order = profile.line.word_order
        self._functions = profile.cycle.functions
        self._written = [one.write for one in plan.cycle if one.write is not None]
        self._words: list[_WrittenRegister] = []
        self._spans: list[RegisterSpan] = []
        self._believed: set[str] = set()
        self._sent: dict[int, deque[int]] = {}
        self._settings: list[tuple[RegisterSpan, list[tuple[Parameter, int]]]] = []
        self._values: Mapping[str, float] = {}
        self._keep = self._polls = self._settings_polls = 0
        self._tight = False
        self._next_s = 0.0
        self.seen = False              # another master has commanded the drive

    def prepare(
        self, read_back: Collection[str], values: Mapping[str, float], rated_nm: float, period_s: float,
        round_s: float, transactions: int, feed: Callable[[], object],
    ) -> None:
        """Record the settings at the end of preflight. ``read_back``: setpoints ('speed') that are known to read back.

        ``round_s``: duration of a cycle of so many ``transactions``. ``feed`` feeds the watchdog meanwhile.
        """
        self._values = values
        words = _words_of(self._profile, values, rated_nm)
        self._words = [word for word in words if any(span.covers(word.register) for span in self._written)]
        self._spans = self._readable_spans([word.register for word in self._words])
        self._believed = {f"{name} setpoint" for name in read_back}
        self._keep = math.ceil(REMEMBERED_S / period_s) + 2
        self._tight = round_s * (1.0 + 1.0 / max(1, transactions)) > ROOM * period_s
        watchdog, cycle = self._profile.watchdog, self._profile.cycle
        signals = (cycle.speed_setpoint, cycle.torque_setpoint, cycle.speed, cycle.torque)
        scaling = {signal.times for signal in signals if signal is not None} | {self._profile.rated_torque}
        # Parameters on which the safety or the result of the run depends.
        own = {watchdog.parameter, watchdog.reaction_parameter} | scaling
        watched = [one for one in self._profile.parameters if one.register_ is not None and (
            one.set_to is not None or one.require is not None or one.name in own)]
        self._settings = []
        open_ones = self._readable_spans([one.register_ for one in watched if one.register_ is not None])
        while open_ones:
            feed()
            span = open_ones.pop(0)
            inside = [one for one in watched if one.register_ is not None and span.covers(one.register_)]
            try:
                found = self._access.read_words(span.table, span.address, span.length)
            except RegisterRefused:
                if len(inside) > 1:    # one of them, or a register between: read each alone
                    registers = [one.register_ for one in inside if one.register_ is not None]
                    open_ones += [RegisterSpan(one.table, one.address, one.count) for one in registers]
                continue               # a missing register was noted or refused earlier
            self._settings.append((span, [(one, self._number(one.register_, span, found)) for one in inside]))
        self._next_s = self._access.clock.now_s()

    def sent(self, image: Mapping[int, int]) -> None:
        """Record the words of a cycle before they are sent."""
        for address, word in image.items():
            self._sent.setdefault(address, deque(maxlen=self._keep or None)).append(word)

    def poll(self, timeout_s: float) -> None:
        """Read once if it is due. Raises CommunicationLost with the value that another master has written.

        A check without an answer is ignored: the cycle reports a bad line.
        """
        now_s = self._access.clock.now_s()
        if now_s < self._next_s - 1e-9 or not self._keep:
            return
        self._polls += 1
        self._next_s = now_s + (EVERY_TIGHT_S if self._tight else EVERY_S) * (0.5 + self._polls * GOLDEN % 1.0)
        every = SETTINGS_EVERY_TIGHT if self._tight else SETTINGS_EVERY
        if self._settings and (self._polls % every == 0 or not self._spans):
            span, parameters = self._settings[self._settings_polls % len(self._settings)]
            self._settings_polls += 1
            found = self._read(span, timeout_s)
            if found is not None:
                self._compare_settings(span, found, parameters)
        elif self._spans and self._sent:
            span = self._spans[self._polls % len(self._spans)]
            found = self._read(span, timeout_s)
            if found is not None:
                self._compare_words(span, found)

    def _read(self, span: RegisterSpan, timeout_s: float) -> tuple[int, ...] | None:
        function = pdu.READ_HOLDING if span.table == "holding" else pdu.READ_INPUT
        try:
            return self._access.once(pdu.read(function, span.address, span.length), timeout_s).words
        except LinkLost:
            raise
        except (CommunicationLost, RegisterRefused):
            return None

    def _compare_words(self, span: RegisterSpan, found: tuple[int, ...]) -> None:
        for word in self._words:
            register = word.register
            if not span.covers(register):
                continue
            addresses = range(register.address, register.address + register.count)
            words = [found[address - span.address] for address in addresses]
            ours = all(one in self._sent.get(at, ()) for at, one in zip(addresses, words, strict=True))
            if ours and any(words):
                self._believed.add(word.name)
            elif not ours and word.name in self._believed:
                self.seen = True
                last = from_words([self._sent[at][-1] for at in addresses], register.type, self._order)
                other = from_words(words, register.type, self._order)
                raise CommunicationLost(
                    f"another master commands this drive: the {word.name} in the drive is {word.shown(other)}, and this"
                    f" run wrote {word.shown(last)}",
                    where=register_name(register),
                    next_step=f"{_TAKE_OFF}; only one master may write control word and setpoints",
                    entry=MessageCode.FOREIGN_MASTER,
                )

    def _compare_settings(self, span: RegisterSpan, found: tuple[int, ...],
                          parameters: list[tuple[Parameter, int]]) -> None:
        for parameter, before in parameters:
            register = parameter.register_
            assert register is not None
            now = self._number(register, span, found)
            if now != before:
                raise CommunicationLost(
                    f"another master changed a setting during the run: '{parameter.title}' was"
                    f" {self._shown(parameter, before)}, and is {self._shown(parameter, now)}",
                    where=register_name(register),
                    next_step=f"{_TAKE_OFF}; check this setting before the next run",
                    entry=MessageCode.FOREIGN_MASTER,
                )

    def _readable_spans(self, registers: list[Register]) -> list[RegisterSpan]:
        tables = {"holding": pdu.READ_HOLDING, "input": pdu.READ_INPUT}
        asked = [one for one in registers if one.table == "holding" or tables[one.table] in self._functions]
        if pdu.READ_HOLDING not in self._functions:
            asked = [one for one in asked if one.table != "holding"]
        return spans(asked, self._profile.cycle.largest_gap, self._profile.cycle.largest_read)

    def _number(self, register: Register | None, span: RegisterSpan, found: tuple[int, ...]) -> int:
        assert register is not None
        at = register.address - span.address
        return from_words(found[at : at + register.count], register.type, self._order)

    def _shown(self, parameter: Parameter, counts: int) -> str:
        scale = per_count(parameter, self._values)
        return f"{counts} counts" if scale is None else show(counts * scale, parameter)


def _words_of(profile: ModbusProfile, values: Mapping[str, float], rated_nm: float) -> list[_WrittenRegister]:
    """Return control word and setpoints, with text in SI."""
    cycle = profile.cycle

    def in_si(signal: CyclicSignal, unit: str) -> Callable[[int], str]:
        scale = si_per_count(signal, values, rated_nm)
        return lambda counts: f"{counts * scale:.4g} {unit}"

    found = [
        _WrittenRegister("control word", cycle.control.register_, lambda word: f"{word & 0xFFFF:04X}h"),
        _WrittenRegister("speed setpoint", cycle.speed_setpoint.register_, in_si(cycle.speed_setpoint, "rad/s")),
    ]
    torque = cycle.torque_setpoint
    if torque is not None and profile.modes.torque and torque.register_ != cycle.speed_setpoint.register_:
        found.append(_WrittenRegister("torque setpoint", torque.register_, in_si(torque, "N·m")))
    return found
