"""Wrong reports: the effect of a wrong sensor, power stage or report on the drive's own quantities.

::

    shaft ──► sensor ──► control ──► power stage ──► shaft
                │           │             │
                ▼           ▼             ▼
              speed,      demand        torque      each through its distortions ──► the words on the bus
              angle

A distortion of the *report* changes the value on the bus; the drive itself continues with the true value. A distortion
of the *sensor* also changes the input of the drive's speed control, its speed limiter and its position counter. A fault
of the *power stage* changes the torque on the shaft.

One table, `LIES`, serves every bus. A quantity is distorted in SI. A word (all zero, all ones, another signal's count)
is distorted where the bus makes its number. Knows no bus and no clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from sim_bus.fault_script import FaultKind, M, factor, number, seconds, share


class Feedback(Enum):
    """Signal of the drive's feedback."""

    __hash__ = object.__hash__     # Enum's own is Python code, too slow for a look-up in every cycle

    SPEED = "speed"
    TORQUE = "torque"
    DEMAND = "demand"
    POSITION = "position"
    STATUS = "status"


# ---------------------------------------------------------------------------------------------------------------------
# Distortions of a quantity in SI. Each object has the memory of one signal.


class Distortion:
    """A distortion: another value instead of the true one."""

    def step(self, value: float, _dt_s: float) -> float:
        """Return the distorted value of the true ``value``, ``dt_s`` later."""
        return value


class Linear(Distortion):
    """Wrong scale and wrong zero. A scale of 0 is a lost signal."""

    def __init__(self, scale: float, offset: float = 0.0) -> None:
        self._scale, self._offset = scale, offset

    def step(self, value: float, _dt_s: float) -> float:
        return self._scale * value + self._offset


class FrozenValue(Distortion):
    """Frozen value: the first one stays."""

    def __init__(self) -> None:
        self._value: float | None = None

    def step(self, value: float, _dt_s: float) -> float:
        if self._value is None:
            self._value = value
        return self._value


class DelayedValue(Distortion):
    """Delayed value: every value comes ``delay_s`` later. Until then the first one stays."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self._now_s = 0.0
        self._on_their_way: deque[tuple[float, float]] = deque()
        self._value: float | None = None

    def step(self, value: float, dt_s: float) -> float:
        self._now_s += dt_s
        self._on_their_way.append((self._now_s + self._delay_s, value))
        if self._value is None:
            self._value = value
        while self._on_their_way[0][0] <= self._now_s:
            self._value = self._on_their_way.popleft()[1]
        return self._value


class Coarse(Distortion):
    """Coarse value: multiples of ``step`` only."""

    def __init__(self, step: float) -> None:
        self._step = step

    def step(self, value: float, _dt_s: float) -> float:
        return self._step * round(value / self._step)


class Slipping(Distortion):
    """Slipping coupling of the sensor: it stands still for this share of every `SLIP_PERIOD_S`."""

    def __init__(self, share: float) -> None:
        self._slips_s = share * SLIP_PERIOD_S
        self._now_s = 0.0

    def step(self, value: float, dt_s: float) -> float:
        self._now_s = (self._now_s + dt_s) % SLIP_PERIOD_S
        return 0.0 if self._now_s < self._slips_s else value


SLIP_PERIOD_S = 1.0
"""Time of half a turn of the default rig's shaft at its usual speed, s."""


# ---------------------------------------------------------------------------------------------------------------------
# Distortions of a word, where a bus makes its number. ``Read`` returns a signal's number on this bus.


Read = Callable[[], float]


class Word:
    """A distortion of a word: another number instead of the true one."""

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        """Return the number of a signal whose true number is ``read()``. ``ones``: all bits set; ``other``: another
        signal's number.
        """
        raise NotImplementedError


class Zero(Word):
    """The word is zero."""

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        return 0


class Ones(Word):
    """All bits are set."""

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        return ones


class Kept(Word):
    """Frozen word: the number that is read first stays."""

    def __init__(self) -> None:
        self._number: float | None = None

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        if self._number is None:
            self._number = read()
        return self._number


class Swapped(Word):
    """Swapped word: the number of another signal, as in a mapping with two entries exchanged."""

    def __init__(self, signal: Feedback) -> None:
        self._signal = signal

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        return other(self._signal)


# ---------------------------------------------------------------------------------------------------------------------
# Effect of the power stage on the torque that control demands.


@dataclass(frozen=True)
class PowerStage:
    """True torque on the shaft, and the drive's own value of it."""

    factor: float = 1.0
    """Factor on the torque that the drive assumes: a wrong torque constant, or motor phases exchanged (−1)."""
    in_stop: float = 1.0
    """Factor on the torque while the drive stops the shaft; the drive measures the real torque."""
    stuck_nm: float | None = None
    """Torque while the power stage is on, N·m, independent of the demand. The drive measures it."""

    def torque(self, wanted_nm: float, *, stopping: bool) -> tuple[float, float]:
        """Return the true torque and the drive's own value of it, N·m."""
        believed = wanted_nm if self.stuck_nm is None else self.stuck_nm
        if stopping:
            believed *= self.in_stop
        return self.factor * believed, believed


# ---------------------------------------------------------------------------------------------------------------------


class Lies:
    """All active distortions of one drive. An inverter owns it; faults of a script `begin` and `end`."""

    def __init__(self) -> None:
        self._values: dict[Feedback, list[Distortion]] = {}
        self._words: dict[Feedback, list[Word]] = {}
        self._sensor: list[tuple[Distortion, Distortion]] = []
        self._stages: list[PowerStage] = []
        self._readers: dict[Feedback, Read] = {}
        self._told: dict[Feedback, float] = {}
        self._clean_rad_s = self._slipped_rad = 0.0
        # Plain attributes, because every step of the plant reads them.
        self.of_values = False
        """True if a quantity is reported wrong."""
        self.of_sensor = False
        """True if the sensor is wrong."""
        self.of_stage = False
        """True if the power stage is wrong."""

    # -- for the inverter ----------------------------------------------------------------------------------

    def measured(self, speed_rad_s: float, noise_rad_s: float, dt_s: float) -> float:
        """Return the speed that a wrong sensor measures, rad/s."""
        clean = speed_rad_s
        noisy = speed_rad_s + noise_rad_s
        for of_angle, of_speed in self._sensor:
            clean = of_angle.step(clean, dt_s)
            noisy = of_speed.step(noisy, dt_s)
        self._clean_rad_s = clean
        return noisy

    def turned(self, angle_rad: float, dt_s: float) -> None:
        """Take the shaft's travel of one step. A wrong sensor counts the integral of its measured speed,
        without noise.
        """
        self._slipped_rad += self._clean_rad_s * dt_s - angle_rad

    def torque(self, wanted_nm: float, *, stopping: bool) -> tuple[float, float]:
        """Return the true torque and the drive's own value of it, N·m."""
        true = believed = wanted_nm
        for stage in self._stages:
            true, believed = stage.torque(true, stopping=stopping)
        return true, believed

    def told(self, signal: Feedback, value: float, dt_s: float) -> float:
        """Return the reported value of a quantity, one step later. It is called once a step for each signal."""
        chain = self._values.get(signal)
        if chain:
            for one in chain:
                value = one.step(value, dt_s)
            self._told[signal] = value
        return value

    def counted_rad(self, true_rad: float) -> float:
        """Return the angle that the sensor has counted, rad."""
        return true_rad + self._slipped_rad

    # -- for the bus ---------------------------------------------------------------------------------------

    def angle_rad(self, true_rad: float) -> float:
        """Return the reported angle, rad."""
        return self.last(Feedback.POSITION, self.counted_rad(true_rad))

    def last(self, signal: Feedback, true: float) -> float:
        """Return the last reported value of a quantity; the true one without distortion."""
        return self._told.get(signal, true) if self._told else true

    def word(self, signal: Feedback, read: Read, ones: float = -1) -> Read:
        """Return ``read`` with its distortions. ``ones``: number with all bits set (NaN for a REAL32)."""
        self._readers[signal] = read
        chain = self._words.setdefault(signal, [])      # the list is kept; `add_word` and `remove_word` change it

        def number() -> float:
            return read() if not chain else chain[-1].number(read, ones, self._other)

        return number

    def _other(self, signal: Feedback) -> float:
        return self._readers[signal]() if signal in self._readers else 0

    # -- for the script ------------------------------------------------------------------------------------

    def add_value(self, signal: Feedback, one: Distortion) -> None:
        """Distort a quantity from now on."""
        self._values.setdefault(signal, []).append(one)
        self.of_values = True

    def remove_value(self, signal: Feedback, one: Distortion) -> None:
        """End a distortion of a quantity."""
        self._values[signal].remove(one)
        if not self._values[signal]:
            del self._values[signal]
            self._told.pop(signal, None)
        self.of_values = bool(self._values)

    def add_word(self, signal: Feedback, one: Word) -> None:
        """Distort a word from now on. The distortion that was added last acts."""
        self._words.setdefault(signal, []).append(one)

    def remove_word(self, signal: Feedback, one: Word) -> None:
        """End a distortion of a word."""
        self._words[signal].remove(one)

    def add_sensor(self, pair: tuple[Distortion, Distortion]) -> None:
        """Distort the sensor from now on: its angle, and its speed."""
        self._sensor.append(pair)
        self.of_sensor = True

    def remove_sensor(self, pair: tuple[Distortion, Distortion]) -> None:
        """End a distortion of the sensor. The angle that it has missed stays missed."""
        self._sensor.remove(pair)
        self.of_sensor = bool(self._sensor)

    def add_stage(self, stage: PowerStage) -> None:
        """Distort the power stage from now on."""
        self._stages.append(stage)
        self.of_stage = True

    def remove_stage(self, stage: PowerStage) -> None:
        """End a distortion of the power stage."""
        self._stages.remove(stage)
        self.of_stage = bool(self._stages)


# ---------------------------------------------------------------------------------------------------------------------
# The table: a row for each kind of distortion, and a scripted fault for each row and signal.


class Lie:
    """One scripted fault of `LIES`."""

    def begin(self, lies: Lies) -> None:
        """Begin the distortion."""
        raise NotImplementedError

    def end(self, lies: Lies) -> None:
        """End the distortion."""
        raise NotImplementedError


class OfValues(Lie):
    """Quantities are reported wrong."""

    def __init__(self, signals: tuple[Feedback, ...], make: Callable[[], Distortion]) -> None:
        self._all = [(signal, make()) for signal in signals]

    def begin(self, lies: Lies) -> None:
        for signal, one in self._all:
            lies.add_value(signal, one)

    def end(self, lies: Lies) -> None:
        for signal, one in self._all:
            lies.remove_value(signal, one)


class OfWords(Lie):
    """Words on the bus are wrong."""

    def __init__(self, words: tuple[tuple[Feedback, Word], ...]) -> None:
        self._all = words

    def begin(self, lies: Lies) -> None:
        for signal, one in self._all:
            lies.add_word(signal, one)

    def end(self, lies: Lies) -> None:
        for signal, one in self._all:
            lies.remove_word(signal, one)


class OfSensor(Lie):
    """The drive's sensor is wrong."""

    def __init__(self, make: Callable[[], Distortion]) -> None:
        self._pair = make(), make()

    def begin(self, lies: Lies) -> None:
        lies.add_sensor(self._pair)

    def end(self, lies: Lies) -> None:
        lies.remove_sensor(self._pair)


class OfStage(Lie):
    """The drive's power stage is wrong."""

    def __init__(self, stage: PowerStage) -> None:
        self._stage = stage

    def begin(self, lies: Lies) -> None:
        lies.add_stage(self._stage)

    def end(self, lies: Lies) -> None:
        lies.remove_stage(self._stage)


@dataclass(frozen=True)
class ReportFault:
    """A scripted fault. ``make`` gets the text of its value and may raise ValueError. ``value`` '': the fault has no
    value.
    """

    name: str
    summary: str
    make: Callable[[str], Lie]
    value: str = ""
    takes: str = ""
    row: int = 0
    """Row of docs/reference/faults.md; 0: none."""


@dataclass(frozen=True)
class _QuantityDistortion:
    """A kind of distortion of a quantity."""

    name: str
    text: str
    make: Callable[[str], Distortion]
    value: str = ""
    takes: str = ""


def _amount(text: str) -> float:
    if not -1e9 <= number(text) <= 1e9:
        raise ValueError("a number in SI: rad/s, N·m or rad")
    return number(text)


def _step(text: str) -> float:
    if not 0.0 < number(text) <= 1e9:
        raise ValueError("a step above 0 in SI: rad/s, N·m or rad")
    return number(text)


_WAYS = (
    _QuantityDistortion("lost", "reads 0", lambda _: Linear(0.0)),
    _QuantityDistortion("frozen", "stays at its last value", lambda _: FrozenValue()),
    _QuantityDistortion("scale", "is multiplied by this", lambda v: Linear(factor(v)), "1.1", "FACTOR"),
    _QuantityDistortion("sign", "has the opposite sign", lambda _: Linear(-1.0)),
    _QuantityDistortion("offset", "is larger by this, in {unit}", lambda v: Linear(1.0, _amount(v)), "1",
                        "AMOUNT"),
    _QuantityDistortion("delay", "is later by this time", lambda v: DelayedValue(seconds(v)), "500ms", "TIME"),
    _QuantityDistortion("coarse", "is rounded to multiples of this, in {unit}", lambda v: Coarse(_step(v)), "1",
                        "STEP"),
)
_QUANTITIES = {
    Feedback.SPEED: "the reported speed", Feedback.TORQUE: "the reported torque",
    Feedback.DEMAND: "the reported torque demand", Feedback.POSITION: "the reported position",
}
_UNITS = {Feedback.SPEED: "rad/s", Feedback.TORQUE: "N·m", Feedback.DEMAND: "N·m", Feedback.POSITION: "rad"}
_ALL = tuple(Feedback)
_ROW_OF = {Feedback.SPEED: 116, Feedback.TORQUE: 118, Feedback.POSITION: 119}
"""Row of the fault table for a quantity that is reported wrong. The torque demand has none."""


def _of_value(signal: Feedback, words: str, way: _QuantityDistortion) -> ReportFault:
    row = 117 if (signal, way.name) == (Feedback.SPEED, "scale") else _ROW_OF.get(signal, 0)
    return ReportFault(f"{signal.value}-{way.name}", f"{words} {way.text.format(unit=_UNITS[signal])}",
                       lambda value: OfValues((signal,), lambda: way.make(value)), way.value, way.takes, row)


def _of_sensor(way: _QuantityDistortion) -> ReportFault:
    text = way.text.format(unit=_UNITS[Feedback.SPEED])
    return ReportFault(f"sensor-{way.name}",
                       f"the signal of the drive's speed sensor {text}; speed control and position follow it",
                       lambda value: OfSensor(lambda: way.make(value)), way.value, way.takes, 115)


def _of_words(name: str, summary: str, *words: tuple[Feedback, Callable[[], Word]]) -> ReportFault:
    row = 120 if len(words) == len(_ALL) else _ROW_OF.get(words[0][0], 0)
    return ReportFault(name, summary, lambda _: OfWords(tuple((signal, make()) for signal, make in words)), row=row)


def _of_stage(name: str, summary: str, make: Callable[[str], PowerStage], value: str = "",
              takes: str = "") -> ReportFault:
    row = 0 if name == "torque-constant" else 121
    return ReportFault(name, summary, lambda text: OfStage(make(text)), value, takes, row)


_ROWS = (
    *(_of_value(signal, words, way) for signal, words in _QUANTITIES.items() for way in _WAYS),
    *(_of_words(f"{signal.value}-ones", f"{words} has all bits set", (signal, Ones))
      for signal, words in _QUANTITIES.items()),
    *(_of_sensor(way) for way in (
        *_WAYS,
        _QuantityDistortion("slips", "does not change for this share of each second", lambda v: Slipping(share(v)),
                            "30%", "SHARE"))),
    _of_words("speed-swapped", "the reported speed is the count of the torque",
              (Feedback.SPEED, lambda: Swapped(Feedback.TORQUE))),
    _of_words("torque-swapped", "the reported torque is the count of the speed",
              (Feedback.TORQUE, lambda: Swapped(Feedback.SPEED))),
    _of_words("speed-torque-swapped", "the counts of reported speed and torque are exchanged",
              (Feedback.SPEED, lambda: Swapped(Feedback.TORQUE)), (Feedback.TORQUE, lambda: Swapped(Feedback.SPEED))),
    _of_words("status-zero", "the statusword is 0000h", (Feedback.STATUS, Zero)),
    _of_words("status-ones", "the statusword is FFFFh", (Feedback.STATUS, Ones)),
    _of_words("status-frozen", "the statusword does not change", (Feedback.STATUS, Kept)),
    _of_words("feedback-zero", "all reports are 0, the statusword too", *((signal, Zero) for signal in _ALL)),
    _of_words("feedback-ones", "all reports have all bits set, the statusword too",
              *((signal, Ones) for signal in _ALL)),
    ReportFault("feedback-delay", "speed, torque, demand and position are later by this time",
                lambda v: OfValues(tuple(_QUANTITIES), lambda: DelayedValue(seconds(v))), "500ms", "TIME"),
    ReportFault("encoder-inverted", "the reported speed has the wrong sign",
                lambda _: OfValues((Feedback.SPEED,), lambda: Linear(-1.0)), row=36),
    _of_stage("torque-constant", "the true torque is the reported and demanded torque times this factor",
              lambda v: PowerStage(factor=factor(v)), "0.5", "FACTOR"),
    _of_stage("motor-polarity", "the true torque has the opposite sign of the reported and demanded torque",
              lambda _: PowerStage(factor=-1.0)),
    _of_stage("quick-stop-inverted", "a quick stop accelerates the shaft; the drive reports the true torque",
              lambda _: PowerStage(in_stop=-1.0)),
    _of_stage("torque-stuck", "the torque stays at this value, N·m, while the power stage is on; the drive reports it",
              lambda v: PowerStage(stuck_nm=_amount(v)), "100", "TORQUE"),
)
LIES: dict[str, ReportFault] = {row.name: row for row in _ROWS}
"""Scripted faults by name, for every bus."""


def lying(act: Callable[[Lie], M]) -> dict[str, FaultKind[M]]:
    """Return the table as faults of one bus. ``act`` converts a fault into one of the bus."""
    def make(row: ReportFault) -> Callable[[str], M]:
        return lambda value: act(row.make(value))

    return {row.name: FaultKind(row.row, row.summary, make(row), row.value, row.takes) for row in LIES.values()}
