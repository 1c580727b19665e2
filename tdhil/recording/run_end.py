"""Cause that ended a run early: written into its log as typed fields, and read back from it, also from older logs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from drivers import TdhilError
from tdhil.errors import ExitCode, Interrupted, code_of, exit_code
from tdhil.recording.log_format import FAILURE, INTERRUPTED, Event


@dataclass(frozen=True)
class RunEnd:
    """Cause of an early end. ``kind``: class of the error, such as DriveFault; ``time_s``: control time;
    ``exit_code``: of the run.
    """

    kind: str
    what: str
    where: str
    next_step: str
    exit_code: int
    time_s: float
    code: str = ""      # code in the table of messages; '' in a log of an older version

    @property
    def message(self) -> str:
        """Text of the event, with its place."""
        return f"{self.where}: {self.what}" if self.where else self.what


def ended_by(error: BaseException, time_s: float) -> dict[str, Any]:
    """Return the cause for the log's configuration, under `ended`."""
    what, where, next_step = str(error), "", ""
    if isinstance(error, TdhilError):
        what, where, next_step = error.what, error.where, error.next_step
    return asdict(RunEnd(type(error).__name__, what, where, next_step, int(exit_code(error)), time_s,
                         code_of(error)))


def find_ended(configuration: Mapping[str, Any], events: tuple[Event, ...]) -> RunEnd | None:
    """Return the cause that ended the run of this log; None if the run was complete, or the log ends first.

    Logs older than 0.2 have the cause only as text in an event.
    """
    found = configuration.get("ended")
    if isinstance(found, Mapping):
        text = {name: str(found.get(name, "")) for name in ("kind", "what", "where", "next_step", "code")}
        return RunEnd(**text, exit_code=_code(found.get("exit_code")), time_s=_number(found.get("time_s")))
    for event in events:
        if event.kind == INTERRUPTED:
            by_hand = "Ctrl-C" in event.text
            code = ExitCode.INTERRUPTED if by_hand else ExitCode.TERMINATED
            return RunEnd(Interrupted.__name__, event.text, "", "", int(code), event.time_s)
        if event.kind == FAILURE:
            kind, _, said = event.text.partition(": ")
            known = {one.__name__: one for one in _below(TdhilError)}.get(kind)
            code = exit_code(known("")) if known is not None and known is not Interrupted else ExitCode.INTERNAL
            return RunEnd(kind, said, "", "", int(code), event.time_s)
    return None


def _below(kind: type[TdhilError]) -> Iterator[type[TdhilError]]:
    yield kind
    for one in kind.__subclasses__():
        yield from _below(one)


def _code(value: object) -> int:
    with suppress(ValueError):
        if isinstance(value, int):
            return int(ExitCode(value))
    return int(ExitCode.INTERNAL)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
