"""Readable content of a damaged log, and a clean copy of it.

The copy is made from the messages that can be read, so it contains no damage. One more event states the lost parts: the
copy is a whole file, but its reader must know that the run is not complete.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from google.protobuf.message import DecodeError

from tdhil.errors import LogBroken, LogError, LogUnopened, NothingRecoverable
from tdhil.recording.log_format import CHANNELS, CLASSES, EVENT, LOG, RECOVERED, Event, log_payload
from tdhil.recording.log_messages import event_message
from tdhil.recording.log_reader import LoggedRun, Ours, messages, read_run
from tdhil.recording.mcap_container import Container

CHUNK_BYTES: Final = 2**18
_GAP_PERIODS: Final = 20.0


@dataclass(frozen=True)
class Gap:
    """Stretch without samples between two samples; control time."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class Salvage:
    """Readable content of a log. ``gaps``: longer than a single missed cycle; ``lost``: one line of text each."""

    run: LoggedRun
    gaps: tuple[Gap, ...]
    lost: tuple[str, ...]

    @property
    def whole(self) -> bool:
        return self.run.complete


def examine(path: Path) -> Salvage:
    """Read all readable content. Raises `NothingRecoverable`."""
    try:
        run = read_run(path, salvage=True)
    except LogError as error:
        raise NothingRecoverable(error.what, where=error.where, next_step=error.next_step) from error
    if not (run.complete or len(run.recording.time_s) or run.events or run.stages or run.configuration):
        raise NothingRecoverable("not one message in it can be read", where=str(path),
                                 next_step="The run has to be done again")
    gaps = find_gaps(run)
    lost = list(run.problems)
    if gaps:
        missing_s = sum(gap.end_s - gap.start_s for gap in gaps)
        lost.append(f"{len(gaps)} gaps between samples, {missing_s:.2f} s in all")
    if not run.complete and not run.configuration:
        lost.append("the configuration: not even whether the run was simulated is known")
    return Salvage(run, gaps, tuple(lost))


def find_gaps(run: LoggedRun) -> tuple[Gap, ...]:
    """Return gaps between samples: more than 20 periods, with the median step as period."""
    time_s = run.recording.time_s
    with np.errstate(invalid="ignore", over="ignore"):        # times in a hostile file may have any value
        steps = np.diff(time_s)
    rising = steps[steps > 0.0]
    if run.complete or len(rising) == 0:
        return ()
    at = np.flatnonzero(steps > _GAP_PERIODS * float(np.median(rising)))
    return tuple(Gap(float(time_s[k]), float(time_s[k + 1])) for k in at)


Edit = Callable[[int, bytes], bytes]
"""Function (channel, payload) → the payload to be written instead."""


def write_copy(source: Path, target: Path, found: Salvage, edit: Edit | None = None, level: int = 1) -> int:
    """Write all readable content of ``source`` as a finished log to ``target``. Return the number of its messages.

    ``target`` appears only when it is complete. ``level``: of the compression. Raises `LogError`.
    """
    part = target.with_name(target.name + ".part")
    try:
        file = part.open("wb", buffering=0)
    except OSError as error:
        raise LogUnopened(f"the copy can't be opened: {error.strerror}", where=str(target),
                          next_step="Choose another file") from error
    try:
        with file:
            count = _copy(source, Container(file, level), found, edit)
            with suppress(OSError):            # not every file has a disk
                os.fsync(file.fileno())
        part.replace(target)
    except OSError as error:
        raise LogBroken(f"the copy can't be written: {error.strerror}", where=str(target),
                        next_step="Free some space, or choose another disk") from error
    finally:
        part.unlink(missing_ok=True)
    return count


def _copy(source: Path, container: Container, found: Salvage, edit: Edit | None) -> int:
    count, last_ns = 0, 0
    for one in messages(source, salvage=True):
        if not isinstance(one, Ours) or not _reads(one):
            continue
        payload = one.payload if edit is None else edit(one.number, one.payload)
        container.add(one.number, one.log_time_ns, payload)
        count += 1
        last_ns = one.log_time_ns
        if container.size > CHUNK_BYTES:
            container.close_chunk()
    if not found.whole:
        time_s = found.run.recording.time_s
        said = f"recovered from a damaged log; lost: {'; '.join(found.lost)}"
        event = event_message(Event(float(time_s[-1]) if len(time_s) else 0.0, RECOVERED, said))
        for channel, payload in ((event.channel, event.payload), (LOG, log_payload(RECOVERED, said, last_ns))):
            container.add(channel, last_ns, payload if edit is None else edit(channel, payload))
    container.close_chunk()
    container.finish()
    return count


def _reads(one: Ours) -> bool:
    try:
        message = CLASSES[CHANNELS[one.number][1]].FromString(one.payload)
    except DecodeError:
        return False
    # a copy of a copy states the lost parts only once
    return not (one.number == EVENT and message.kind == RECOVERED)
