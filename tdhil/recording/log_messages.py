"""The rare messages, through the protobuf classes, laid out where they are handed in.

So a value that has no place in the log is refused in the caller's own stack, and what the caller changes
afterwards isn't logged by mistake.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final, NamedTuple

from tdhil.record.errors import LogError
from tdhil.record.event import Event
from tdhil.record.plain import plain
from tdhil.recording.log_format import CLASSES, CONFIGURATION, EVENT, EXCITATION, RESULT, STAGE
from tdhil.recording.recording import Excitation, Level, Ramp, Stage

TEXT_LIMIT: Final = 4 * 2**20          # bytes of JSON; the reader refuses more
_EVENT_LIMIT: Final = 2**16


class Cold(NamedTuple):
    """``time_s`` is control time, None for that of the record before; ``flush`` closes the chunk after it."""

    channel: int
    time_s: float | None
    payload: bytes
    flush: bool


def stage_message(stage: Stage) -> Cold:
    """A `Stage`, at its end."""
    return Cold(STAGE, stage.end_s, _bytes("Stage", asdict(stage)), flush=True)


def excitation_message(excitation: Excitation | None, levels: Sequence[Level], ramps: Sequence[Ramp]) -> Cold:
    """A `Motion`."""
    content = {
        "excitation": None if excitation is None else asdict(excitation),
        "levels": [asdict(level) for level in levels],
        "ramps": [asdict(ramp) for ramp in ramps],
    }
    return Cold(EXCITATION, None, _bytes("Motion", content), flush=True)


def event_message(event: Event) -> Cold:
    """An `Event`; what is longer than 64 Ki characters is cut."""
    content = {
        "time_s": event.time_s,
        "kind": event.kind,
        "text": _clean(event.text),
        "traceback": _clean(event.traceback),
    }
    return Cold(EVENT, event.time_s, _bytes("Event", content), flush=False)


def configuration_message(run: Mapping[str, Any], facts: Mapping[str, Any]) -> Cold:
    """The run's configuration and the facts that a Recording needs, as one JSON text."""
    return _text(CONFIGURATION, {"run": run, "recording": {name: plain(value) for name, value in facts.items()}})


def result_message(result: Mapping[str, Any]) -> Cold:
    """The result as a JSON text."""
    return _text(RESULT, result)


def _text(channel: int, content: Mapping[str, Any]) -> Cold:
    try:
        text = json.dumps(content, ensure_ascii=False)
        payload = _bytes("Text", {"json": text})
    except (TypeError, ValueError) as error:
        raise LogError(f"this can't be logged as JSON: {error}") from error
    if len(payload) > TEXT_LIMIT:
        raise LogError(f"a text of {len(payload)} bytes is too long for the log (limit {TEXT_LIMIT})")
    return Cold(channel, None, payload, flush=True)


def _bytes(message: str, content: Mapping[str, Any]) -> bytes:
    payload: bytes = CLASSES[message](**content).SerializeToString()
    return payload


def _clean(text: str) -> str:
    """A surrogate (a file name that isn't UTF-8) has no place in protobuf."""
    return text[:_EVENT_LIMIT].encode(errors="replace").decode()
