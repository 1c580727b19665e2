"""What ended a run before its time: written into its log as typed fields, and found there again, in older logs too."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from drivers.errors import TdhilError
from tdhil.errors import ExitCode, Interrupted, exit_code
from tdhil.record.event import FAILURE, INTERRUPTED, Event


@dataclass(frozen=True)
class Ended:
    """``kind`` is the error's class, such as DriveFault; ``time_s`` is control time; ``exit_code`` is the run's."""

    kind: str
    what: str
    where: str
    next_step: str
    exit_code: int
    time_s: float

    @property
    def message(self) -> str:
        """What happened, and where."""
        return f"{self.where}: {self.what}" if self.where else self.what


def ended_by(error: BaseException, time_s: float) -> dict[str, Any]:
    """For the log's configuration, under `ended`."""
    what, where, next_step = str(error), "", ""
    if isinstance(error, TdhilError):
        what, where, next_step = error.what, error.where, error.next_step
    return asdict(Ended(type(error).__name__, what, where, next_step, int(exit_code(error)), time_s))


def find_ended(configuration: Mapping[str, Any], events: tuple[Event, ...]) -> Ended | None:
    """What ended the run of this log; None where it came to its end, or where the log ends first.

    Logs of before 0.2 have it in an event only, in words.
    """
    found = configuration.get("ended")
    if isinstance(found, Mapping):
        text = {name: str(found.get(name, "")) for name in ("kind", "what", "where", "next_step")}
        return Ended(**text, exit_code=_code(found.get("exit_code")), time_s=_number(found.get("time_s")))
    for event in events:
        if event.kind == INTERRUPTED:
            by_hand = "Ctrl-C" in event.text
            code = ExitCode.INTERRUPTED if by_hand else ExitCode.TERMINATED
            return Ended(Interrupted.__name__, event.text, "", "", int(code), event.time_s)
        if event.kind == FAILURE:
            kind, _, said = event.text.partition(": ")
            known = {one.__name__: one for one in _below(TdhilError)}.get(kind)
            code = exit_code(known("")) if known is not None and known is not Interrupted else ExitCode.INTERNAL
            return Ended(kind, said, "", "", int(code), event.time_s)
    return None


def _below(kind: type[TdhilError]) -> Iterator[type[TdhilError]]:
    yield kind
    for one in kind.__subclasses__():
        yield from _below(one)


def _code(value: object) -> int:
    return value if isinstance(value, int) and value in set(ExitCode) else int(ExitCode.INTERNAL)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
