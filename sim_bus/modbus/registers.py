"""The register bank: request PDUs in, reply PDUs out (Modbus application protocol V1.1b3, sections 6.3 to 6.17).

::

    03, 04  address count                                     → bytes, words
    06      address word                                      → the same
    08      000Eh 0 (requests to this drive so far)           → the same, the count
    16      address count bytes words                         → address count
    23      read address count, write address count bytes …   → bytes, words; the write comes first
    else    exception 1; unknown address 2; bad count or value 3; not possible now 4

A read takes all registers at one moment. A write checks everything before anything acts.
"""


from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import floor, pi
from struct import Struct
from typing import NamedTuple

from profiles import MARKER_REGISTER, MARKER_REGISTERS, MARKER_STAGE_REGISTER, MARKER_TEXT
from profiles.modbus import CyclicSignal, Echo, ModbusProfile, Register, Temperature
from sim_bus.cia402 import Application
from sim_bus.modbus.codec import RegisterLayout
from sim_bus.modbus.control_words import ControlWords
from sim_bus.modbus.parameters import ParameterStore
from sim_bus.modbus.wrong_maps import (
    DeviceFailure,
    IllegalAddress,
    IllegalFunction,
    IllegalValue,
    RequestRefused,
    Wrong,
)
from sim_bus.reports import Feedback

# ---------------------------------------------------------------------------------------------------------------------
# Content of each register: the profile's map over the simulated drive, with its scripted errors.
#
# Numbers in a slot are those of the register (counts). The drive itself scales them, in floats. A number that doesn't
# fit saturates, as in a drive.


HOT_C = 120.0
"""Highest temperature of the simulated drive's motor, °C."""


@dataclass(frozen=True, slots=True)
class Slot:
    """One number in its registers. ``refuses`` raises the errors of `sim_bus.modbus.wrong_maps`; then nothing is
    written.
    """

    layout: RegisterLayout
    read: Callable[[], int]
    write: Callable[[int], None] | None = None
    refuses: Callable[[int], None] | None = None
    commands: bool = False
    """True for the control word and for setpoints."""


class Map:
    """All slots. If two use one register, the first counts."""

    def __init__(self, profile: ModbusProfile, parameters: ParameterStore, words: ControlWords,
                 wrongs: tuple[Wrong, ...],
                 *, stepped: bool, on_stage: Callable[[int], None] = lambda _number: None) -> None:
        self._profile = profile
        self._parameters = parameters
        self._words = words
        self._application: Application = words.application
        self._wrongs = {wrong.kind for wrong in wrongs}
        self.temperature_c = 40.0      # of all parts that report a temperature
        self._speed_counts = 0
        self._torque_counts = 0
        named = self._cycle() + self._mode() + self._echoes() + self._position()
        named += [Slot(RegisterLayout(address), extra.read, extra.write) for address, extra in words.extras().items()]
        named += self._settings() + self._temperatures()
        self.slots: dict[tuple[str, int], Slot] = {}
        for slot in named:
            self._lay(replace(slot, layout=self._moved(slot.layout)))
        self._fill_gaps(profile.cycle.largest_gap)
        text = MARKER_TEXT.encode("ascii").ljust(2 * MARKER_REGISTERS, b"\0")
        marker = [int.from_bytes(text[at : at + 2], "big") for at in range(0, len(text), 2)]
        for number, word in enumerate([*marker, int(stepped)]):
            self._lay(Slot(RegisterLayout(MARKER_REGISTER + number), lambda word=word: word))  # type: ignore[misc]
        self._stage = 0
        self._on_stage = on_stage
        self._lay(Slot(RegisterLayout(MARKER_STAGE_REGISTER), lambda: self._stage, self._set_stage))

    def act(self) -> None:
        """Apply the setpoints. If the drive ignores them now, they are kept."""
        application, words, cycle = self._application, self._words, self._profile.cycle
        if not words.listens:
            return
        speed = self._to_si(cycle.speed_setpoint, self._speed_counts)
        application.target_speed_rad_s = -speed if words.reversed else speed
        if cycle.torque_setpoint is not None:
            application.target_torque_nm = self._to_si(cycle.torque_setpoint, self._torque_counts)

    # -- content of the registers --------------------------------------------------------------------------

    def _cycle(self) -> list[Slot]:
        cycle, words, application = self._profile.cycle, self._words, self._application
        inverter, reporting = application.inverter, application.inverter.reporting
        slots = [
            Slot(self._layout(cycle.control.register_), lambda: words.word, words.write, commands=True),
            self._lying(Feedback.STATUS, Slot(self._layout(cycle.status.register_), self._status)),
            Slot(self._layout(cycle.speed_setpoint.register_), lambda: self._speed_counts, self._set_speed,
                 commands=True),
            self._lying(Feedback.SPEED, self._reported(cycle.speed, lambda: reporting.speed_rad_s)),
            self._lying(Feedback.TORQUE, self._reported(cycle.torque, lambda: reporting.torque_nm)),
        ]
        if cycle.torque_setpoint is not None:
            slots.append(Slot(self._layout(cycle.torque_setpoint.register_), lambda: self._torque_counts,
                              self._set_torque, commands=True))
        if cycle.torque_demand is not None:
            demand = self._reported(cycle.torque_demand, lambda: inverter.reported_demand_nm)
            slots.append(self._lying(Feedback.DEMAND, demand))
        return slots

    def _mode(self) -> list[Slot]:
        modes, words = self._profile.modes, self._words
        slots = []
        if modes.register_ is not None:
            values = (modes.speed_value, modes.torque_value)

            def refuses(value: int) -> None:
                if value not in values:
                    raise IllegalValue
                if not words.may_switch(value == values[1]):
                    raise DeviceFailure

            slots.append(Slot(self._layout(modes.register_), lambda: values[words.register_says_torque] or 0,
                              lambda value: words.select_by_register(value == values[1]), refuses))
        if modes.display is not None:
            slots.append(Slot(self._layout(modes.display.register_), self._display))
        return slots

    def _echoes(self) -> list[Slot]:
        """Return the echoes of setpoints, in SI: not the registers that the host wrote."""
        application = self._application
        targets: dict[str, Callable[[], float]] = {
            "speed": lambda: application.target_speed_rad_s, "torque": lambda: application.target_torque_nm,
        }
        return [self._reported(echo, targets[echo.setpoint]) for echo in self._profile.echoes]

    def _position(self) -> list[Slot]:
        """Return the slots of the sensor's angle, counts. The counter starts over when it is full."""
        position = self._profile.position
        if position is None:
            return []
        layout, inverter = self._layout(position.register_), self._application.inverter

        def read() -> int:
            turned = inverter.reported_angle_rad / (2.0 * pi) * position.counts_per_turn
            if position.wrap_counts is not None:
                turned %= position.wrap_counts
            span = layout.highest - layout.lowest + 1
            return (floor(turned) - layout.lowest) % span + layout.lowest

        return [self._lying(Feedback.POSITION, Slot(layout, read))]

    def _temperatures(self) -> list[Slot]:
        slots = []
        for one in self._profile.temperatures:
            if one.register_ != self._profile.cycle.status.register_:
                layout = self._layout(one.register_)
                slots.append(Slot(layout, partial(self._temperature, layout, one)))
        return slots

    def _temperature(self, layout: RegisterLayout, one: Temperature) -> int:
        """Return its number, or a word with its bits in the required state."""
        if one.too_hot is not None:
            return one.too_hot.value if self._is_hot else ~one.too_hot.value & one.too_hot.mask
        share = self.temperature_c / (1.0 if one.unit == "celsius" else HOT_C)
        return layout.saturated(share / one.per_lsb)

    @property
    def _is_hot(self) -> bool:
        return self.temperature_c > HOT_C

    def _settings(self) -> list[Slot]:
        """Return the slots of the parameters. Those that preflight or the operator sets may be written."""
        parameters, slots = self._parameters, list[Slot]()
        for one in self._profile.parameters:
            if one.register_ is None:
                continue
            layout = self._layout(one.register_)
            writable = one.set_to is not None or one.require is not None
            slots.append(Slot(layout, partial(self._told, layout, one.name),
                              partial(parameters.write, one.name) if writable else None))
        return slots

    def _lying(self, signal: Feedback, slot: Slot) -> Slot:
        """Return a slot whose number passes the scripted distortions of its word."""
        layout = slot.layout
        ones = -1 if layout.signed else layout.highest
        number = self._application.inverter.lies.word(signal, slot.read, ones)
        return replace(slot, read=lambda: layout.saturated(number()))

    # -- helpers -------------------------------------------------------------------------------------------

    def _reported(self, signal: CyclicSignal | Echo, quantity: Callable[[], float]) -> Slot:
        echo = isinstance(signal, Echo)
        layout = self._layout(signal.register_, echo=echo)
        parameters = self._parameters

        def read() -> int:
            scale = parameters.scale(signal.per_lsb, signal.unit, signal.times, echo=echo)
            return self._signed(layout, layout.saturated(parameters.in_unit(quantity(), signal.unit) / scale))

        return Slot(layout, read)

    def _told(self, layout: RegisterLayout, name: str) -> int:
        return self._signed(layout, layout.saturated(self._parameters.number(name)))

    def _to_si(self, signal: CyclicSignal, counts: int) -> float:
        scale = self._parameters.scale(signal.per_lsb, signal.unit, signal.times)
        return self._parameters.si(counts * scale, signal.unit)

    def _set_speed(self, counts: int) -> None:
        self._speed_counts = counts

    def _set_torque(self, counts: int) -> None:
        self._torque_counts = counts

    def _set_stage(self, number: int) -> None:
        self._stage = number
        self._on_stage(number)

    def _status(self) -> int:
        """Return the family's status word with the user's wiring; on ABB bit 11 is the family's own."""
        word, display = self._words.status(), self._profile.modes.display
        status = self._profile.cycle.status.register_
        for one in self._profile.temperatures:
            if one.register_ == status and one.too_hot is not None and self._is_hot:
                word = word & ~one.too_hot.mask | one.too_hot.value
        if display is not None and display.register_.address == status.address \
                and display.register_.table == status.table and self._profile.control.family != "abb":
            return word & ~display.mask | self._display()
        return word

    def _display(self) -> int:
        display = self._profile.modes.display
        if display is None:
            return 0
        return (display.torque if self._words.torque else display.speed) & display.mask

    def _signed(self, layout: RegisterLayout, number: int) -> int:
        """Return the number as the drive reports it."""
        if "sign" in self._wrongs and layout.signed:
            return layout.saturated(-number)
        return number

    def _layout(self, register: Register, *, echo: bool = False) -> RegisterLayout:
        signless = "unsigned" in self._wrongs and not echo
        kind = register.type.replace("i", "u") if signless else register.type
        high_first = self._profile.line.word_order == "high_first"
        return RegisterLayout(register.address, kind, register.table, high_first is not ("word_order" in self._wrongs))

    def _moved(self, layout: RegisterLayout) -> RegisterLayout:
        return replace(layout, address=layout.address + 1) if "address_off_by_one" in self._wrongs else layout

    def _lay(self, slot: Slot) -> None:
        keys = [(slot.layout.table, address) for address in slot.layout.addresses]
        if not any(key in self.slots for key in keys):
            self.slots.update(dict.fromkeys(keys, slot))

    def _fill_gaps(self, largest: int) -> None:
        """Add registers with the value 0 between two of the map that may be read together."""
        for table in ("holding", "input"):
            taken = sorted(address for where, address in self.slots if where == table)
            for low, high in pairwise(taken):
                if high - low - 1 <= largest:
                    for address in range(low + 1, high):
                        self._lay(Slot(RegisterLayout(address, table=table), lambda: 0))


# ---------------------------------------------------------------------------------------------------------------------

_REQUESTS_SO_FAR = 0x000E
_PAIR = Struct(">HH")
_WRITE = Struct(">HHB")
_BOTH = Struct(">HHHHB")


class Answer(NamedTuple):
    """A reply, and the effect of its request."""

    pdu: bytes
    wrote: bool = False
    commanded: bool = False
    """True if the request wrote the control word or a setpoint."""


class Bank:
    """Content of each address, for the functions that the drive supports."""

    def __init__(self, slots: Mapping[tuple[str, int], Slot], functions: tuple[int, ...], written: Callable[[], None],
                 *, largest_read: int, largest_write: int) -> None:
        self._slots = slots
        self._written = written         # applies the written values
        self._largest_read = largest_read
        self._largest_write = largest_write
        known: dict[int, Callable[[bytes], Answer]] = {
            3: lambda data: Answer(self._read("holding", data)),
            4: lambda data: Answer(self._read("input", data)),
            6: self._write_one,
            8: self._diagnostics,
            16: self._write_many,
            23: self._read_and_write,
        }
        self._asked = 0
        self._known = {code: known[code] for code in {3, *functions}}

    def answer(self, pdu: bytes) -> Answer:
        """Return the reply to one request. Never raises."""
        code = pdu[0] if pdu else 0
        self._asked += 1
        try:
            if code not in self._known:
                raise IllegalFunction
            answer = self._known[code](pdu[1:])
        except RequestRefused as refused:
            return Answer(bytes((code | 0x80, refused.code)))
        return answer._replace(pdu=pdu[:1] + answer.pdu)

    def _diagnostics(self, data: bytes) -> Answer:
        if len(data) != _PAIR.size or _PAIR.unpack(data) != (_REQUESTS_SO_FAR, 0):
            raise IllegalValue
        return Answer(_PAIR.pack(_REQUESTS_SO_FAR, self._asked & 0xFFFF))

    def _read(self, table: str, data: bytes) -> bytes:
        words: list[int] = []
        for slot, first, count in self._parts(table, *self._span(data)):
            words += slot.layout.words(slot.read())[first : first + count]
        return bytes((2 * len(words),)) + Struct(f">{len(words)}H").pack(*words)

    def _span(self, data: bytes) -> tuple[int, int]:
        """Return the first address and the number of registers that a request reads."""
        if len(data) != _PAIR.size:
            raise IllegalValue
        address, count = _PAIR.unpack(data)
        if not 1 <= count <= self._largest_read:
            raise IllegalValue
        return address, count

    def _parts(self, table: str, address: int, count: int) -> list[tuple[Slot, int, int]]:
        """Return each slot of a range of registers, with the first of its registers and how many are in the range."""
        parts, at, end = [], address, address + count
        while at < end:
            slot = self._slots.get((table, at))
            if slot is None:
                raise IllegalAddress
            first = at - slot.layout.address
            length = min(len(slot.layout.addresses) - first, end - at)
            parts.append((slot, first, length))
            at += length
        return parts

    def _write_one(self, data: bytes) -> Answer:
        if len(data) != _PAIR.size:
            raise IllegalValue
        address, word = _PAIR.unpack(data)
        return Answer(data, True, self._write(address, [word]))

    def _write_many(self, data: bytes) -> Answer:
        if len(data) < _WRITE.size:
            raise IllegalValue
        address, count, _ = _WRITE.unpack_from(data)
        commanded = self._write(address, self._words_of(data[_WRITE.size - 1 :], count))
        return Answer(data[: _PAIR.size], True, commanded)

    def _read_and_write(self, data: bytes) -> Answer:
        if len(data) < _BOTH.size:
            raise IllegalValue
        read, read_count, write, write_count, _ = _BOTH.unpack_from(data)
        words = self._words_of(data[_BOTH.size - 1 :], write_count)
        self._parts("holding", *self._span(data[: _PAIR.size]))      # refused before anything is written
        commanded = self._write(write, words)
        return Answer(self._read("holding", _PAIR.pack(read, read_count)), True, commanded)

    def _words_of(self, data: bytes, count: int) -> list[int]:
        """Return the words after their byte count."""
        if not 1 <= count <= self._largest_write or data[0] != 2 * count or len(data) != 1 + 2 * count:
            raise IllegalValue
        return [int.from_bytes(data[at : at + 2], "big") for at in range(1, len(data), 2)]

    def _write(self, address: int, words: list[int]) -> bool:
        """Write registers. Return whether one of them commands. Half of a 32-bit number leaves the other
        half as it is.
        """
        numbers = []
        for slot, first, length in self._parts("holding", address, len(words)):
            if slot.write is None:
                raise IllegalAddress
            written, words = words[:length], words[length:]
            if length < len(slot.layout.addresses):
                image = list(slot.layout.words(slot.read()))
                image[first : first + length] = written
                written = image
            numbers.append((slot, slot.layout.number(tuple(written))))
        for slot, number in numbers:
            if slot.refuses is not None:
                slot.refuses(number)
        for slot, number in numbers:
            if slot.write is not None:
                slot.write(number)
        self._written()
        return any(slot.commands for slot, _ in numbers)
