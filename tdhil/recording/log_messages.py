"""Encoding of the rare messages through the protobuf classes, in the caller's thread.

An invalid value is therefore refused in the caller's own stack, and later changes by the caller do not reach the log.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from struct import Struct
from typing import Any, Final, NamedTuple

from drivers import Command, Mode, PowerState, RawFrame, Sample
from tdhil.errors import LogError, MessageCode
from tdhil.recording.builder import plain
from tdhil.recording.log_format import (
    CLASSES,
    CONFIGURATION,
    EVENT,
    EXCITATION,
    FRF,
    FRF_COLUMNS,
    LIVE_INERTIA,
    LOG,
    MODES,
    RESULT,
    STAGE,
    STATES,
    VIRTUAL_COLUMNS,
    VIRTUAL_STRING,
    Event,
    LiveInertia,
)
from tdhil.recording.recording import Excitation, Level, Ramp, Stage

# ---------------------------------------------------------------------------------------------------------------------
# The three messages of every cycle, encoded without protobuf's classes: its wire format by one `struct.pack`.
#
# A tag is (field number << 3) | wire type: 0 varint, 1 eight bytes, 2 length and bytes, 5 four bytes. Little-endian.
#
# ::
#
#     Sample   09 time_s:8  11 speed_rad_s:8  19 torque_nm:8  21 age_s:8  29 half_width_s:8
#              30 fresh:1  38 limit_active:1  40 standstill:1  48 state:1  50 mode:1  5D status:4
#              [61 torque_demand_nm:8]                                    only where the drive reports it
#              [69 position_rad:8]                                        only where the cycle brought one
#     Command  09 time_s:8  11 speed_rad_s:8  19 torque_nm:8  20 mode:1
#              [29 torque_offset_nm:8]                                    only where there is one
#     Frames   09 time_s:8  { 12 length  Frame } …
#     Frame    09 time_s:8  10 outgoing:1  1D identifier:4  22 length  data
#
# Zeros are written, although protobuf would leave them out: both read the same, and the layout stays constant. Field
# numbers and types are those of `log_format.MESSAGES`. Raises struct.error for an integer out of its range.


_SAMPLE = Struct("<BdBdBdBdBd B?B?B?BBBB BI".replace(" ", ""))
_MORE = Struct("<Bd")
_COMMAND = Struct("<BdBdBdBB")
SAMPLE_SIZE: Final = _SAMPLE.size      # bytes without torque demand and position, which take `MORE_SIZE` each
COMMAND_SIZE: Final = _COMMAND.size    # bytes without the torque offset, which takes `MORE_SIZE`
MORE_SIZE: Final = _MORE.size
DEMAND_TAG: Final = 0x61
POSITION_TAG: Final = 0x69
OFFSET_TAG: Final = 0x29
TORQUE_MODE: Final = MODES[Mode.TORQUE]
ENABLED_STATE: Final = STATES[PowerState.ENABLED]


def pack_sample(sample: Sample) -> bytes:
    """Return a `Sample` message."""
    (time_s, age_s, half_width_s, fresh, speed_rad_s, torque_nm, demand_nm,
     mode, state, standstill, limit_active, status, position_rad) = sample
    fixed = _SAMPLE.pack(
        0x09, time_s, 0x11, speed_rad_s, 0x19, torque_nm, 0x21, age_s, 0x29, half_width_s,
        0x30, fresh, 0x38, limit_active, 0x40, standstill, 0x48, STATES[state], 0x50, MODES[mode], 0x5D, status,
    )
    if demand_nm is not None:
        fixed += _MORE.pack(DEMAND_TAG, demand_nm)
    return fixed if position_rad is None else fixed + _MORE.pack(POSITION_TAG, position_rad)


def pack_command(time_s: float, command: Command) -> bytes:
    """Return a `Command` message; ``time_s`` is control time."""
    mode, speed_rad_s, torque_nm, offset_nm = command
    fixed = _COMMAND.pack(0x09, time_s, 0x11, speed_rad_s, 0x19, torque_nm, 0x20, MODES[mode])
    return fixed if offset_nm == 0.0 else fixed + _MORE.pack(OFFSET_TAG, offset_nm)


def pack_frames(frames: list[RawFrame]) -> bytes:
    """Return a `Frames` message of at least one frame; its time is that of the first frame."""
    parts = [_MORE.pack(0x09, frames[0][0])]
    for time_s, outgoing, identifier, data in frames:
        layout, head, tail = _frame_layout(len(data))
        parts.append(layout.pack(head, time_s, 0x10, outgoing, 0x1D, identifier, tail, data))
    return b"".join(parts)


@lru_cache(maxsize=512)
def _frame_layout(length: int) -> tuple[Struct, bytes, bytes]:
    """Return the layout for ``length`` bytes of data, the bytes before time_s, and the bytes before the data."""
    tail = b"\x22" + _varint(length)
    head = b"\x12" + _varint(1 + 8 + 2 + 5 + len(tail) + length) + b"\x09"
    return Struct(f"<{len(head)}sdB?BI{len(tail)}s{length}s"), head, tail


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


# ---------------------------------------------------------------------------------------------------------------------

TEXT_LIMIT: Final = 4 * 2**20          # bytes of JSON; the reader refuses more
_EVENT_LIMIT: Final = 2**16


class Cold(NamedTuple):
    """Encoded rare message. ``time_s``: control time, None for that of the record before; ``flush``: close the chunk
    after it.
    """

    channel: int
    time_s: float | None
    payload: bytes
    flush: bool


def rehearsal_mark(faults: Sequence[Any]) -> Cold:
    """Return a line of /log with the mark of a rehearsal, as text. Its final message has the log's time in it."""
    text = f"{', '.join(map(str, faults))}. The drive is simulated. The history of the rig does not include this run"
    return Cold(LOG, None, text.encode(), flush=False)


def stage_message(stage: Stage) -> Cold:
    """Return a `Stage` message, at its end."""
    return Cold(STAGE, stage.end_s, _bytes("Stage", asdict(stage)), flush=True)


def excitation_message(excitation: Excitation | None, levels: Sequence[Level], ramps: Sequence[Ramp]) -> Cold:
    """Return a `Motion` message."""
    content = {
        "excitation": None if excitation is None else asdict(excitation),
        "levels": [asdict(level) for level in levels],
        "ramps": [asdict(ramp) for ramp in ramps],
    }
    return Cold(EXCITATION, None, _bytes("Motion", content), flush=True)


def event_message(event: Event) -> Cold:
    """Return an `Event`; text beyond 64 Ki characters is cut."""
    content = {
        "time_s": event.time_s,
        "kind": event.kind,
        "text": _clean(event.text),
        "traceback": _clean(event.traceback),
    }
    return Cold(EVENT, event.time_s, _bytes("Event", content), flush=False)


_VIRTUAL = Struct("<" + "Bd" * len(VIRTUAL_COLUMNS))
_VIRTUAL_TAGS = [number << 3 | 1 for number in range(1, len(VIRTUAL_COLUMNS) + 1)]      # below 16: one byte each


def virtual_message(row: Sequence[float]) -> Cold:
    """Return a `VirtualString` message, encoded by struct because there is one a cycle."""
    fields = [part for pair in zip(_VIRTUAL_TAGS, row, strict=True) for part in pair]
    return Cold(VIRTUAL_STRING, row[0], _VIRTUAL.pack(*fields), flush=False)


def configuration_message(run: Mapping[str, Any], facts: Mapping[str, Any]) -> Cold:
    """Return the run's configuration and the facts of a Recording, as one JSON text."""
    return _text(CONFIGURATION, {"run": run, "recording": {name: plain(value) for name, value in facts.items()}})


def result_message(result: Mapping[str, Any]) -> Cold:
    """Return the result as a JSON text."""
    return _text(RESULT, result)


def response_message(found: Mapping[str, Any]) -> Cold:
    """Return the frequency response of a result document as arrays for a viewer's plot; an open side is NaN."""
    def value(line: Mapping[str, Any], name: str) -> float:
        key, _, side = name.rpartition("_") if name.endswith(("_low", "_high")) else (name, "", "value")
        one = line[key]
        number = one[side] if isinstance(one, Mapping) else one
        return math.nan if number is None else float(number)

    content: dict[str, Any] = {name: [value(line, name) for line in found["lines"]] for name in FRF_COLUMNS}
    content["distortion_detected"] = bool(found["distortion"]["detected"])
    return Cold(FRF, None, _bytes("Response", content), flush=False)


def inertia_message(found: LiveInertia) -> Cold:
    """A `LiveInertia`; at once in the file, since pages wait for it."""
    content = {name: value for name, value in asdict(found).items() if value is not None}
    return Cold(LIVE_INERTIA, None, _bytes("LiveInertia", content | {"reason": _clean(found.reason)}), flush=True)


def _text(channel: int, content: Mapping[str, Any]) -> Cold:
    try:
        text = json.dumps(content, ensure_ascii=False)
        payload = _bytes("Text", {"json": text})
    except (TypeError, ValueError) as error:
        raise LogError(f"this can't be logged as JSON: {error}", entry=MessageCode.LOG_TEXT_TOO_LARGE) from error
    if len(payload) > TEXT_LIMIT:
        raise LogError(f"a text of {len(payload)} bytes is too long for the log (limit {TEXT_LIMIT})",
                       entry=MessageCode.LOG_TEXT_TOO_LARGE)
    return Cold(channel, None, payload, flush=True)


def _bytes(message: str, content: Mapping[str, Any]) -> bytes:
    payload: bytes = CLASSES[message](**content).SerializeToString()
    return payload


def _clean(text: str) -> str:
    """Return the text without surrogates (from a file name that is not UTF-8), which protobuf does not accept."""
    return text[:_EVENT_LIMIT].encode(errors="replace").decode()
