"""Temperatures that the drive reports: warning bits in every status word, numbers every other second."""

from __future__ import annotations

from drivers.drive import Outcome
from drivers.errors import CommunicationLost, LimitHit, PreflightRefused
from drivers.modbus import pdu
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import from_words, register_name
from drivers.modbus.pdu import LinkLost, RegisterRefused
from drivers.modbus.state_machine import seen
from drivers.preflight import PreflightTable
from profiles import MessageCode
from profiles.modbus import ModbusProfile, Temperature

EVERY_S = 2.0
UNWATCHED = "not monitored: the profile names no register; the drive trips by itself, and may then coast"


class Heat:
    """Checks one temperature after the other. Each one that is too hot is reported once."""

    def __init__(self, access: RegisterAccess, profile: ModbusProfile) -> None:
        self._access = access
        self._order = profile.line.word_order
        self._status = profile.cycle.status.register_
        self._in_status = [one for one in profile.temperatures if one.too_hot and one.register_ == self._status]
        self._numbers = [one for one in profile.temperatures if one not in self._in_status]
        self._limit_c: float | None = None
        self._watched: list[Temperature] = []
        self._reported: set[str] = set()
        self._next_s = 0.0
        self._polls = 0

    def prepare(self, table: PreflightTable, limit_c: float | None) -> None:
        """Add a row for each; one that is too hot now is refused. ``limit_c``: the limit in rig.yaml, °C, if any."""
        self._limit_c = limit_c
        if not self._numbers and not self._in_status:
            table.note("temperature", UNWATCHED, "profile, temperatures")
        celsius = [one for one in self._numbers if one.unit == "celsius" and one.too_hot is None]
        if limit_c is not None and not celsius:
            table.row(
                "temperature limit", f"{limit_c:g} °C", "this profile names no register with a temperature", False,
                "limits.temperature_c", "Remove it from rig.yaml: it would have no effect",
            )
        for one in self._in_status:
            self._row(table, one, self._access.read(self._status))
        for one in self._numbers:
            try:
                self._row(table, one, self._access.read(one.register_))
            except PreflightRefused as error:
                table.note(one.title, f"not monitored: {error.what}", register_name(one.register_))
        self._next_s = self._access.clock.now_s()

    def _row(self, table: PreflightTable, one: Temperature, counts: int) -> None:
        limit = self._limit_of(one)
        where = register_name(one.register_)
        if one.too_hot is None and limit is None:
            step = "Give limits.temperature_c in rig.yaml, °C"
            table.note(one.title, f"{_shown(one, counts)}, no limit: not monitored", where, step)
            return
        self._watched.append(one)
        wanted = "not too hot" if limit is None else f"at most {_text(one, limit)}"
        good = not self._too_hot(one, counts)
        table.row(one.title, wanted, _shown(one, counts), good, where, "Let it cool down")
        assert table.checks[-1].outcome is not Outcome.NOTE

    def see(self, status: int) -> None:
        """Check the status word of a cycle. Raises LimitHit."""
        for one in self._in_status:
            self._judge(one, status)

    def poll(self, timeout_s: float) -> None:
        """Read one value if it is due; a missing answer is ignored. Raises LimitHit, and LinkLost."""
        now_s = self._access.clock.now_s()
        numbers = [one for one in self._watched if one in self._numbers]
        if not numbers or now_s < self._next_s:
            return
        self._next_s = now_s + EVERY_S
        one = numbers[self._polls % len(numbers)]
        self._polls += 1
        register = one.register_
        function = pdu.READ_HOLDING if register.table == "holding" else pdu.READ_INPUT
        try:
            words = self._access.once(pdu.read(function, register.address, register.count), timeout_s).words
        except LinkLost:
            raise
        except (CommunicationLost, RegisterRefused):
            return
        self._judge(one, from_words(words, register.type, self._order))

    def _judge(self, one: Temperature, counts: int) -> None:
        if one.title in self._reported or not self._too_hot(one, counts):
            return
        self._reported.add(one.title)
        limit = self._limit_of(one)
        beyond = "" if limit is None else f", beyond the limit of {_text(one, limit)}"
        raise LimitHit(
            f"too hot: {one.title}: {_shown(one, counts)}{beyond}. The shaft is being stopped",
            where=register_name(one.register_),
            next_step="Let it cool down. Request less torque or fewer periods",
            entry=MessageCode.DRIVE_TOO_HOT,
        )

    def _limit_of(self, one: Temperature) -> float | None:
        if one.too_hot is not None:
            return None
        limits = [limit for limit in (one.at_most, self._limit_c if one.unit == "celsius" else None) if limit]
        return min(limits, default=None)

    def _too_hot(self, one: Temperature, counts: int) -> bool:
        limit = self._limit_of(one)
        return seen(one.too_hot, counts & 0xFFFF) if limit is None else counts * one.per_lsb > limit


def _text(one: Temperature, value: float) -> str:
    return f"{value:.4g} °C" if one.unit == "celsius" else f"{100.0 * value:.4g} %"


def _shown(one: Temperature, counts: int) -> str:
    if one.too_hot is not None:
        return "too hot" if seen(one.too_hot, counts & 0xFFFF) else "not too hot"
    return _text(one, counts * one.per_lsb)
