"""Lying reports: what a wrong sensor, a wrong power stage or a wrong report makes of the drive's own quantities.

::

    shaft ──► sensor ──► control ──► power stage ──► shaft
                │           │             │
                ▼           ▼             ▼
              speed,      demand        torque      each through its distortions ──► the words on the bus
              angle

A distortion of the *report* changes what the bus carries; the drive itself goes on with the true value. A distortion of
the *sensor* is what the drive's speed control, its speed limiter and its position counter get as well. A fault of the
*power stage* changes the torque on the shaft.

One table, `LIES`, serves every bus. A quantity is distorted in SI; a word (all zero, all ones, another signal's count)
where the bus makes its number. Knows no bus and no clock.
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
    """Another value instead of the true one."""

    def step(self, value: float, _dt_s: float) -> float:
        """The value after ``dt_s`` more, for the true one."""
        return value


class Linear(Distortion):
    """A wrong scale and a wrong zero; a scale of 0 is a signal that is lost."""

    def __init__(self, scale: float, offset: float = 0.0) -> None:
        self._scale, self._offset = scale, offset

    def step(self, value: float, _dt_s: float) -> float:
        return self._scale * value + self._offset


class FrozenValue(Distortion):
    """The first value stays."""

    def __init__(self) -> None:
        self._value: float | None = None

    def step(self, value: float, _dt_s: float) -> float:
        if self._value is None:
            self._value = value
        return self._value


class DelayedValue(Distortion):
    """Every value comes ``delay_s`` later; until then the first one stays."""

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
    """Only multiples of ``step`` are there."""

    def __init__(self, step: float) -> None:
        self._step = step

    def step(self, value: float, _dt_s: float) -> float:
        return self._step * round(value / self._step)


class Slipping(Distortion):
    """The coupling of the sensor slips: it stands still for this share of every `SLIP_PERIOD_S`."""

    def __init__(self, share: float) -> None:
        self._slips_s = share * SLIP_PERIOD_S
        self._now_s = 0.0

    def step(self, value: float, dt_s: float) -> float:
        self._now_s = (self._now_s + dt_s) % SLIP_PERIOD_S
        return 0.0 if self._now_s < self._slips_s else value


SLIP_PERIOD_S = 1.0
"""Time of half a turn of the default rig's shaft at its usual speed, s."""


# ---------------------------------------------------------------------------------------------------------------------
# Distortions of a word, where a bus makes its number. ``Read`` is how a signal's number is made on this bus.


Read = Callable[[], float]


class Word:
    """Another number instead of the true one."""

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        """For a signal that would read ``read()``. ``ones``: all bits set; ``other``: another signal's number."""
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
    """The number that is read first stays."""

    def __init__(self) -> None:
        self._number: float | None = None

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        if self._number is None:
            self._number = read()
        return self._number


class Swapped(Word):
    """The number of another signal: a mapping with two entries exchanged."""

    def __init__(self, signal: Feedback) -> None:
        self._signal = signal

    def number(self, read: Read, ones: float, other: Callable[[Feedback], float]) -> float:
        return other(self._signal)


# ---------------------------------------------------------------------------------------------------------------------
# What the power stage makes of the torque that control wants.


@dataclass(frozen=True)
class PowerStage:
    """The torque on the shaft, and what the drive takes it for."""

    factor: float = 1.0
    """Factor on the torque that the drive assumes: a wrong torque constant, or motor phases exchanged (−1)."""
    in_stop: float = 1.0
    """Factor on the torque while the drive stops the shaft; the drive measures the real torque."""
    stuck_nm: float | None = None
    """The torque while the power stage is on, whatever control wants; the drive measures it."""

    def torque(self, wanted_nm: float, *, stopping: bool) -> tuple[float, float]:
        """True torque and torque that the drive believes in, N·m."""
        believed = wanted_nm if self.stuck_nm is None else self.stuck_nm
        if stopping:
            believed *= self.in_stop
        return self.factor * believed, believed


# ---------------------------------------------------------------------------------------------------------------------


class Lies:
    """All distortions of one drive that act at present. An inverter owns it; faults of a script `begin` and `end`."""

    def __init__(self) -> None:
        self._values: dict[Feedback, list[Distortion]] = {}
        self._words: dict[Feedback, list[Word]] = {}
        self._sensor: list[tuple[Distortion, Distortion]] = []
        self._stages: list[PowerStage] = []
        self._readers: dict[Feedback, Read] = {}
        self._told: dict[Feedback, float] = {}
        self._clean_rad_s = self._slipped_rad = 0.0
        # Plain attributes: every step of the plant looks at them.
        self.of_values = False
        """A quantity is reported wrong."""
        self.of_sensor = False
        """The sensor is wrong."""
        self.of_stage = False
        """The power stage is wrong."""

    # -- for the inverter ----------------------------------------------------------------------------------

    def measured(self, speed_rad_s: float, noise_rad_s: float, dt_s: float) -> float:
        """Speed as a wrong sensor measures it."""
        clean = speed_rad_s
        noisy = speed_rad_s + noise_rad_s
        for of_angle, of_speed in self._sensor:
            clean = of_angle.step(clean, dt_s)
            noisy = of_speed.step(noisy, dt_s)
        self._clean_rad_s = clean
        return noisy

    def turned(self, angle_rad: float, dt_s: float) -> None:
        """The shaft has turned so far; a wrong sensor counts the integral of the speed it measures, without noise."""
        self._slipped_rad += self._clean_rad_s * dt_s - angle_rad

    def torque(self, wanted_nm: float, *, stopping: bool) -> tuple[float, float]:
        """True torque and torque that the drive believes in, N·m."""
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
        """The angle as the sensor has counted it."""
        return true_rad + self._slipped_rad

    # -- for the bus ---------------------------------------------------------------------------------------

    def angle_rad(self, true_rad: float) -> float:
        """The angle that is reported."""
        return self.last(Feedback.POSITION, self.counted_rad(true_rad))

    def last(self, signal: Feedback, true: float) -> float:
        """Return the last reported value of a quantity; the true one without distortion."""
        return self._told.get(signal, true) if self._told else true

    def word(self, signal: Feedback, read: Read, ones: float = -1) -> Read:
        """``read`` as the bus gets it; ``ones``: the number whose bits are all set (of a REAL32: no number)."""
        self._readers[signal] = read
        chain = self._words.setdefault(signal, [])      # the list stays; `add_word` and `remove_word` change it

        def number() -> float:
            return read() if not chain else chain[-1].number(read, ones, self._other)

        return number

    def _other(self, signal: Feedback) -> float:
        return self._readers[signal]() if signal in self._readers else 0

    # -- for the script ------------------------------------------------------------------------------------

    def add_value(self, signal: Feedback, one: Distortion) -> None:
        """A quantity is distorted from now on."""
        self._values.setdefault(signal, []).append(one)
        self.of_values = True

    def remove_value(self, signal: Feedback, one: Distortion) -> None:
        """And no more."""
        self._values[signal].remove(one)
        if not self._values[signal]:
            del self._values[signal]
            self._told.pop(signal, None)
        self.of_values = bool(self._values)

    def add_word(self, signal: Feedback, one: Word) -> None:
        """A word is distorted from now on; the last one that was added acts."""
        self._words.setdefault(signal, []).append(one)

    def remove_word(self, signal: Feedback, one: Word) -> None:
        """And no more."""
        self._words[signal].remove(one)

    def add_sensor(self, pair: tuple[Distortion, Distortion]) -> None:
        """The sensor is wrong from now on: in its angle, and in its speed."""
        self._sensor.append(pair)
        self.of_sensor = True

    def remove_sensor(self, pair: tuple[Distortion, Distortion]) -> None:
        """And right again; the angle that was missed stays missed."""
        self._sensor.remove(pair)
        self.of_sensor = bool(self._sensor)

    def add_stage(self, stage: PowerStage) -> None:
        """The power stage is wrong from now on."""
        self._stages.append(stage)
        self.of_stage = True

    def remove_stage(self, stage: PowerStage) -> None:
        """And right again."""
        self._stages.remove(stage)
        self.of_stage = bool(self._stages)


# ---------------------------------------------------------------------------------------------------------------------
# The table: a row for each way of lying, a scripted fault for each row and signal.


class Lie:
    """One scripted fault of `LIES`."""

    def begin(self, lies: Lies) -> None:
        """It acts from now on."""
        raise NotImplementedError

    def end(self, lies: Lies) -> None:
        """And no more."""
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
    """A scripted fault: ``make`` of its value's text may raise ValueError. ``value`` '': it takes none."""

    name: str
    summary: str
    make: Callable[[str], Lie]
    value: str = ""
    takes: str = ""
    row: int = 0
    """Row of docs/reference/faults.md; 0: none."""


@dataclass(frozen=True)
class _QuantityDistortion:
    """A way of distorting a quantity."""

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
    _QuantityDistortion("offset", "is larger by this (rad/s, N·m, rad)", lambda v: Linear(1.0, _amount(v)), "1",
                        "AMOUNT"),
    _QuantityDistortion("delay", "comes so much later", lambda v: DelayedValue(seconds(v)), "500ms", "TIME"),
    _QuantityDistortion("coarse", "has only multiples of this (rad/s, N·m, rad)", lambda v: Coarse(_step(v)), "1",
                        "STEP"),
)
_QUANTITIES = {
    Feedback.SPEED: "the reported speed", Feedback.TORQUE: "the reported torque",
    Feedback.DEMAND: "the reported torque demand", Feedback.POSITION: "the reported position",
}
_ALL = tuple(Feedback)
_ROW_OF = {Feedback.SPEED: 116, Feedback.TORQUE: 118, Feedback.POSITION: 119}
"""Row of the fault table for a quantity that is reported wrong. The torque demand has none."""


def _of_value(signal: Feedback, words: str, way: _QuantityDistortion) -> ReportFault:
    row = 117 if (signal, way.name) == (Feedback.SPEED, "scale") else _ROW_OF.get(signal, 0)
    return ReportFault(f"{signal.value}-{way.name}", f"{words} {way.text}",
                       lambda value: OfValues((signal,), lambda: way.make(value)), way.value, way.takes, row)


def _of_sensor(way: _QuantityDistortion) -> ReportFault:
    return ReportFault(f"sensor-{way.name}", f"the drive's own speed sensor {way.text}; control and position follow it",
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
        _QuantityDistortion("slips", "stands still for this share of every second", lambda v: Slipping(share(v)), "30%",
                     "SHARE"))),
    _of_words("speed-swapped", "the reported speed shows the torque's count",
              (Feedback.SPEED, lambda: Swapped(Feedback.TORQUE))),
    _of_words("torque-swapped", "the reported torque shows the speed's count",
              (Feedback.TORQUE, lambda: Swapped(Feedback.SPEED))),
    _of_words("speed-torque-swapped", "reported speed and torque show each other's count",
              (Feedback.SPEED, lambda: Swapped(Feedback.TORQUE)), (Feedback.TORQUE, lambda: Swapped(Feedback.SPEED))),
    _of_words("status-zero", "the statusword is 0000h", (Feedback.STATUS, Zero)),
    _of_words("status-ones", "the statusword is FFFFh", (Feedback.STATUS, Ones)),
    _of_words("status-frozen", "the statusword stays as it is", (Feedback.STATUS, Kept)),
    _of_words("feedback-zero", "all reports are 0, the statusword too", *((signal, Zero) for signal in _ALL)),
    _of_words("feedback-ones", "all reports have all bits set, the statusword too",
              *((signal, Ones) for signal in _ALL)),
    ReportFault("feedback-delay", "speed, torque, demand and position come so much later",
                lambda v: OfValues(tuple(_QUANTITIES), lambda: DelayedValue(seconds(v))), "500ms", "TIME"),
    ReportFault("encoder-inverted", "the reported speed has the wrong sign",
                lambda _: OfValues((Feedback.SPEED,), lambda: Linear(-1.0)), row=36),
    _of_stage("torque-constant", "the true torque is this times what the drive reports and demands",
              lambda v: PowerStage(factor=factor(v)), "0.5", "FACTOR"),
    _of_stage("motor-polarity", "the true torque has the opposite sign of what the drive reports and demands",
              lambda _: PowerStage(factor=-1.0)),
    _of_stage("quick-stop-inverted", "a quick stop of the drive accelerates; the torque is reported as it is",
              lambda _: PowerStage(in_stop=-1.0)),
    _of_stage("torque-stuck", "the torque stays at this, N·m, while the power stage is on; it is reported as it is",
              lambda v: PowerStage(stuck_nm=_amount(v)), "100", "TORQUE"),
)
LIES: dict[str, ReportFault] = {row.name: row for row in _ROWS}
"""Scripted faults by name, for every bus."""


def lying(act: Callable[[Lie], M]) -> dict[str, FaultKind[M]]:
    """The table as faults of one bus; ``act`` makes one of its faults."""
    def make(row: ReportFault) -> Callable[[str], M]:
        return lambda value: act(row.make(value))

    return {row.name: FaultKind(row.row, row.summary, make(row), row.value, row.takes) for row in LIES.values()}
