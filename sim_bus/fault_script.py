"""Begin and end of a scripted fault in plant time, and the text form of a fault. Pure.

::

    NAME[@WHEN][=VALUE][/DURATION]      heartbeat-lost@hold+2s    frame-loss@acquire+5s=5%/20s    sto@12.5s
    WHEN    12.5s  from power-on    STAGE or STAGE+2s  from the moment at which the host reports the stage's begin
            STAGE may also be stop: from the moment of the first request to stop the drive
            left out: from the start
    DURATION  left out: without end
"""

import re
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from math import inf
from textwrap import fill
from typing import Generic, TypeVar

from profiles import STAGE_NUMBERS, MessageCode, TdhilError

FAULT_SEED = 0xFA17
"""Part of the seed by which faults differ from the noise of the drive."""
STOP = max(STAGE_NUMBERS.values()) + 1
"""Number of the moment at which a stop is requested while the shaft turns. No host announces it."""

_MOMENTS = {**STAGE_NUMBERS, "stop": STOP}
_NUMBER = r"\d+(?:\.\d+)?"
_FAULT = re.compile(
    rf"(?P<name>[a-z][a-z0-9-]*)(?:@(?P<when>[^=/]+))?(?:=(?P<value>[^/]+))?(?:/(?P<duration>{_NUMBER}m?s))?"
)
_OBJECT = re.compile(r"(?:0x)?([0-9A-Fa-f]{4})h?(?::([0-9]{1,3}))?")
_WHEN = re.compile(rf"(?:(?P<stage>[a-z]+)(?:\+(?P<after>{_NUMBER}m?s))?|(?P<time>{_NUMBER}m?s))")


class FaultRefused(TdhilError):
    """Error for a text that is no fault that can be scripted."""

    entry = MessageCode.FAULT_SCRIPT_WRONG

    exit_code = 2


@dataclass(frozen=True)
class Moment:
    """Moment of a fault: ``after_s`` of plant time after the begin of a stage (by number), or after power-on for stage
    0.
    """

    stage: int = 0
    after_s: float = 0.0


@dataclass(frozen=True)
class Scripted:
    """One fault of a script, with its original text."""

    name: str
    at: Moment = Moment()
    value: str = ""
    duration_s: float = inf
    text: str = ""


class Schedule:
    """Begin and end of the faults in plant time. Each fault begins once, when its moment is reached the first time."""

    def __init__(self, faults: tuple[Scripted, ...]) -> None:
        self._waiting = list(enumerate(faults))
        self._stages_us = {0: 0}
        self._ends_us: list[tuple[int, int]] = []
        self._next_us = 0

    def stage(self, number: int, now_us: int) -> None:
        """Record the begin of a stage. A repeated begin, after a restart of the host, has no effect."""
        self._stages_us.setdefault(number, now_us)
        self._next_us = 0

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults that have not begun yet, as they were written."""
        return tuple(fault.text for _, fault in self._waiting)

    def due(self, now_us: int) -> tuple[list[int], list[int]]:
        """Return the numbers of the faults that begin now, and of those that end now."""
        if now_us < self._next_us:
            return [], []
        begin = [(n, fault) for n, fault in self._waiting if self._begins_us(fault) <= now_us]
        self._waiting = [pair for pair in self._waiting if pair not in begin]
        end = [n for at_us, n in self._ends_us if at_us <= now_us]
        self._ends_us = [pair for pair in self._ends_us if pair[0] > now_us]
        self._ends_us += [(now_us + round(1e6 * f.duration_s), n) for n, f in begin if f.duration_s < inf]
        times = [self._begins_us(fault) for _, fault in self._waiting] + [at_us for at_us, _ in self._ends_us]
        self._next_us = round(min(times)) if min(times, default=inf) < inf else 1 << 62
        return [n for n, _ in begin], end

    def _begins_us(self, fault: Scripted) -> float:
        began = self._stages_us.get(fault.at.stage)
        return inf if began is None else began + round(1e6 * fault.at.after_s)


class Passing:
    """A fault with a begin and an end; subclasses define both."""

    def begin(self) -> None:
        """Begin the fault."""

    def end(self) -> None:
        """End the fault."""


F = TypeVar("F", bound=Passing)


class Cast(Generic[F]):
    """Faults of a script, in its order, and the active ones. ``note`` is called for each change."""

    def __init__(self, script: tuple[Scripted, ...], make: Callable[[Scripted], F]) -> None:
        self._script = script
        self._schedule = Schedule(script)
        self.all = [make(fault) for fault in script]
        self.active: list[F] = []

    @property
    def waiting(self) -> tuple[str, ...]:
        """Faults that have not begun yet, as they were written."""
        return self._schedule.waiting

    def stage(self, number: int, now_us: int) -> None:
        """Record the begin of a stage."""
        self._schedule.stage(number, now_us)

    def moved(self, now_us: int, note: Callable[[str], None]) -> bool:
        """Begin and end the faults that are due. Return whether there was one."""
        begin, end = self._schedule.due(now_us)
        for number in begin:
            note(f"fault: {self._script[number].text}")
            self.active.append(self.all[number])
            self.all[number].begin()
        for number in end:
            note(f"fault over: {self._script[number].text}")
            self.active.remove(self.all[number])
            self.all[number].end()
        return bool(begin or end)


def parse(text: str) -> Scripted:
    """Return one fault from the user's text; `Kinds` checks its name and value. Raises FaultRefused."""
    found = _FAULT.fullmatch(text.strip())
    if found is None:
        raise FaultRefused(f"{text!r} is no fault", where="--fault",
                           next_step="Write NAME[@WHEN][=VALUE][/DURATION], such as heartbeat-lost@hold+2s. "
                                     "--fault list shows the names")
    duration = found["duration"]
    return Scripted(found["name"], _moment(found["when"], text), found["value"] or "",
                    inf if duration is None else _seconds(duration), text.strip())


def _moment(when: str | None, text: str) -> Moment:
    if when is None:
        return Moment()
    found = _WHEN.fullmatch(when)
    if found is None or found["stage"] not in {None, *_MOMENTS}:
        raise FaultRefused(f"{when!r} is no moment", where=f"--fault {text}",
                           next_step=f"Write 12.5s, or a stage and a time: {', '.join(_MOMENTS)}, as in hold+2s")
    if found["time"] is not None:
        return Moment(0, _seconds(found["time"]))
    return Moment(_MOMENTS[str(found["stage"])], _seconds(found["after"] or "0s"))


def _seconds(text: str) -> float:
    return float(text[:-2]) / 1000.0 if text.endswith("ms") else float(text[:-1])


# ---------------------------------------------------------------------------------------------------------------------
# Parts of a list of scripted faults, for any bus: name, row of the fault table, value, and the look-up of a fault.


M = TypeVar("M")
"""Type of a fault on the bus."""


@dataclass(frozen=True)
class FaultKind(Generic[M]):
    """One entry of the list. ``value``: the default, '' for a fault without a value. ``make`` may raise ValueError."""

    row: int                           # row of docs/reference/faults.md; 0: no row
    summary: str
    make: Callable[[str], M]
    value: str = ""
    takes: str = ""


def number(text: str) -> float:
    """Return the number. Raises ValueError with a text for the user."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a number") from None


def share(text: str) -> float:
    """Return a share from a number or a percentage. Raises ValueError."""
    found = number(text[:-1]) / 100.0 if text.endswith("%") else number(text)
    if not 0.0 <= found <= 1.0:
        raise ValueError("a share from 0 to 1, or 0% to 100%")
    return found


def seconds(text: str) -> float:
    """Return a time, s, from a text such as 1s or 200ms. Raises ValueError."""
    found = number(text[:-2]) / 1000.0 if text.endswith("ms") else number(text.removesuffix("s"))
    if not 0.001 <= found <= 3600.0:
        raise ValueError("a time from 1ms to 3600s")
    return found


def factor(text: str) -> float:
    """Return the factor of a reported quantity. Raises ValueError."""
    found = number(text)
    if not 0.01 <= found <= 100.0:
        raise ValueError("a factor from 0.01 to 100")
    return found


def error_code(text: str) -> int:
    """Return a code such as 7305h. Raises ValueError."""
    if not re.fullmatch(r"(?:0x)?[0-9A-Fa-f]{4}h?", text):
        raise ValueError("an error code of four hexadecimal digits, such as 7305h")
    return int(text.removeprefix("0x").removesuffix("h"), 16)


def object_place(text: str) -> tuple[int, int]:
    """Return index and subindex of an object such as 1016h:1. Raises ValueError."""
    found = _OBJECT.fullmatch(text)
    if found is None or int(found[2] or 0) > 255:
        raise ValueError("an object, such as 6072h or 1016h:1")
    return int(found[1], 16), int(found[2] or 0)


def plain(make: Callable[[], M]) -> Callable[[str], M]:
    """Return a function that makes a fault without a value."""
    return lambda _value: make()


@dataclass(frozen=True)
class KnownFault:
    """A fault that can be scripted. ``row`` of docs/reference/faults.md (0: none); ``takes``: its value, '' for none.

    ``from_start``: the fault acts from the start and without end.
    """

    name: str
    summary: str
    row: int
    value: str
    takes: str
    from_start: bool


class Kinds(dict[str, FaultKind[M]]):
    """Faults of one bus by name."""

    def make(self, fault: Scripted) -> M:
        """Return the effect of a scripted fault. Raises FaultRefused for an unknown name or value."""
        kind = self.get(fault.name)
        where = f"--fault {fault.text or fault.name}"
        if kind is None:
            close = get_close_matches(fault.name[:80], self, n=1)
            hint = f"Did you mean {close[0]!r}? " if close else ""
            raise FaultRefused(f"no fault is called {fault.name!r}", where=where,
                               next_step=f"{hint}--fault list shows them")
        if fault.value and not kind.takes:
            raise FaultRefused(f"{fault.name} takes no value", where=where, next_step="Leave the = out")
        if (at := fault.value.partition("@"))[1]:
            raise FaultRefused(f"{fault.value!r} is no value of {fault.name}: the moment comes before the value",
                               where=where, next_step=f"Write {fault.name}@{at[2]}={at[0]}")
        try:
            return kind.make(fault.value or kind.value)
        except ValueError as error:
            raise FaultRefused(
                f"{fault.value!r} is no value of {fault.name}", where=where,
                next_step=f"It takes {kind.takes}, such as {kind.value} ({error})",
            ) from None

    def parse_all(self, texts: Sequence[str]) -> tuple[Scripted, ...]:
        """Return all faults of a command line, each checked. Raises FaultRefused."""
        faults = tuple(parse(text) for text in texts)
        for fault in faults:
            self.make(fault)
        return faults

    def listed(self, from_start: Container[str] = ()) -> tuple[KnownFault, ...]:
        """Return every fault, in the order of the fault table's rows."""
        return tuple(
            KnownFault(name, kind.summary, kind.row, kind.value, kind.takes, name in from_start)
            for name, kind in sorted(self.items(), key=lambda item: (item[1].row or 99, item[0]))
        )

    def listing(self, width: int) -> str:
        """Return the list of faults with row and value as a text, wrapped at ``width`` columns."""
        wrap = partial(fill, width=width, break_long_words=False, break_on_hyphens=False)
        lines = [
            wrap(f"NAME[@WHEN][=VALUE][/DURATION]; WHEN is 12.5s, or a stage: {', '.join(_MOMENTS)}, hold+2s"),
            "", wrap("row: number of the row in docs/reference/faults.md, with the required reaction"),
            f"{'row':>3}  {'name':<37}what happens",
        ]
        for one in self.listed():
            shown = f"{one.name}[={one.value}]" if one.takes else one.name
            lines.append(wrap(f"{one.row or '-':>3}  {shown:<37}{one.summary}", subsequent_indent=" " * 42))
        return "\n".join(lines)
