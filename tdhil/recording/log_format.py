"""Content of run.mcap: the channels, their numbers and their messages.

====  ===============  =============  =====================================================================
  id  topic            message        when
====  ===============  =============  =====================================================================
   1  /sample          Sample         every cycle, SI at the motor shaft
   2  /command         Command        every cycle
   3  /can             Frames         the frames of a cycle, as they stood on the bus
   4  /stage           Stage          when a stage has ended
   5  /excitation      Motion         excitation, levels and ramps; the last one counts
   6  /event           Event          when something happened
   7  /configuration   Text           JSON: {"run": …, "recording": …}; the last one counts
   8  /result          Text           JSON; the last one counts
   9  /log             foxglove.Log   the same events again, for viewers; never read back
  10  /modbus          Frames         requests and replies (PDU), in place of /can; older logs have them there
  11  /virtual_string  VirtualString  every cycle of a virtual string, at its main shaft
  12  /frames          Frames         the frames of any other bus, in place of /can
  13  /frf             Response       the frequency response of the result, for viewers; never read back
  14  /live_inertia    LiveInertia    J after a period of the excitation; the last one is the result's
====  ===============  =============  =====================================================================

A message's log time is the epoch handed in at the start plus its control time, in nanoseconds.
"""


import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import NoneType, UnionType
from typing import Any, Final, get_args, get_origin

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP

from drivers import Mode, PowerState
from tdhil.recording.builder import hints_of
from tdhil.recording.recording import Excitation, Level, Ramp, Segment, Stage

# ---------------------------------------------------------------------------------------------------------------------
# Event: something in a run that deserves a line, such as an error, a warning, a lost sample, or a key press.


REHEARSAL: Final = "FAULT REHEARSAL"
"""Mark of a run of the simulated drive with scripted faults (`--fault`). Its result does not count for the rig."""


RECOVERED: Final = "recovered"
"""Kind of the event in a recovered copy: the file is complete, but the run in it is not."""


FAILURE: Final = "failure"
INTERRUPTED: Final = "interrupted"
"""Kinds of the event that ended a run: the fault, or the source of the request."""


@dataclass(frozen=True)
class Event:
    """Event. ``time_s``: control time; ``kind``: one lower-case word; ``traceback``: '' without one."""

    time_s: float
    kind: str
    text: str
    traceback: str = ""


# ---------------------------------------------------------------------------------------------------------------------
# The interim answer of a run: J and its interval from the periods so far.


@dataclass(frozen=True)
class LiveInertia:
    """J at the motor shaft from all samples up to ``time_s`` (control time), identified as at the end of the run.

    ``periods``: evaluated so far. ``verdict`` and ``reason`` are those of a result. Without a number the estimates are
    None. ``low`` to ``high`` is the repeatability, ``low_total`` to ``high_total`` includes the torque scale.
    ``tolerance`` and ``least_left_s``, the least time until stage 5 may end on it: None without `--tolerance`.
    """

    time_s: float
    periods: int
    confidence: float
    verdict: str
    reason: str
    inertia_kg_m2: float | None = None
    low_kg_m2: float | None = None
    high_kg_m2: float | None = None
    low_total_kg_m2: float | None = None
    high_total_kg_m2: float | None = None
    p_value: float | None = None
    tolerance: float | None = None
    least_left_s: float | None = None

    @property
    def relative_half_width(self) -> float:
        """Return half the width of the repeatability, as a share of J; infinite without a number."""
        if self.inertia_kg_m2 is None or self.low_kg_m2 is None or self.high_kg_m2 is None:
            return math.inf
        return 0.5 * (self.high_kg_m2 - self.low_kg_m2) / self.inertia_kg_m2


# ---------------------------------------------------------------------------------------------------------------------
# The same events as `foxglove.Log`, which viewers of MCAP show as a log (docs.foxglove.dev, schema Log).
#
# tdhil reads only its own Event; this copy is for viewers.


_LEVELS: Final = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
_INFO, _WARNING, _ERROR = 2, 3, 4
_WARNINGS: Final = frozenset({
    INTERRUPTED, RECOVERED, REHEARSAL, "bus", "clock", "dropped", "fault", "left", "limits", "stop", "warning",
    "watchdog",
})
_NAME: Final = "tdhil"


def _log_class() -> Any:
    file = FileDescriptorProto(name="foxglove/Log.proto", package="foxglove", syntax="proto3",
                               dependency=[TIMESTAMP.name])
    message = file.message_type.add(name="Log")
    level = message.enum_type.add(name="Level")
    for number, name in enumerate(_LEVELS):
        level.value.add(name=name, number=number)
    for number, (name, kind, of) in enumerate((
        ("timestamp", FieldDescriptorProto.TYPE_MESSAGE, ".google.protobuf.Timestamp"),
        ("level", FieldDescriptorProto.TYPE_ENUM, ".foxglove.Log.Level"),
        ("message", FieldDescriptorProto.TYPE_STRING, ""),
        ("name", FieldDescriptorProto.TYPE_STRING, ""),
        ("file", FieldDescriptorProto.TYPE_STRING, ""),
        ("line", FieldDescriptorProto.TYPE_FIXED32, ""),
    ), start=1):
        field = message.field.add(name=name, number=number, type=kind, label=FieldDescriptorProto.LABEL_OPTIONAL)
        if of:
            field.type_name = of
    pool = DescriptorPool()
    pool.AddSerializedFile(TIMESTAMP.serialized_pb)
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("foxglove.Log"))


LOG_CLASS: Final = _log_class()


def log_payload(kind: str, text: str, log_time_ns: int) -> bytes:
    """Return a `foxglove.Log` message of an event, with a level that follows from its kind."""
    level = _ERROR if kind == FAILURE else _WARNING if kind in _WARNINGS else _INFO
    message = LOG_CLASS(level=level, message=f"{kind}: {text}", name=_NAME)
    message.timestamp.seconds, message.timestamp.nanos = divmod(log_time_ns, 10**9)
    payload: bytes = message.SerializeToString()
    return payload


# ---------------------------------------------------------------------------------------------------------------------
# Protobuf message classes from a compact table: no compiler, no generated code, any protobuf runtime from 5 on.
#
# A message is a dictionary from field name to type; the field's number is its place, counted from 1. Fields must
# therefore be added at the end and never be moved. A type is a scalar of protobuf, an enum or a message of the same
# table, with ``?`` for an optional one (absent is not zero) and ``*`` for a repeated one.


Table = Mapping[str, Mapping[str, str]]

_SCALARS = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "int64": FieldDescriptorProto.TYPE_INT64,
    "fixed32": FieldDescriptorProto.TYPE_FIXED32,
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "string": FieldDescriptorProto.TYPE_STRING,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
}
_OF_PYTHON = {float: "double", int: "int64", bool: "bool", str: "string"}


def fields_of(kind: Any) -> dict[str, str]:
    """Return the row of the table for a dataclass, from its annotations."""
    hints = hints_of(kind)
    return {field.name: _type_of(hints[field.name]) for field in fields(kind)}


def message_classes(package: str, enums: Mapping[str, tuple[str, ...]], messages: Table) -> dict[str, Any]:
    """Return a class for each message of the table; the values of an enum count from 0."""
    file = FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
    for name, values in enums.items():
        enum = file.enum_type.add(name=name)
        for number, value in enumerate(values):
            enum.value.add(name=f"{name.upper()}_{value}", number=number)
    for name, row in messages.items():
        _describe(file.message_type.add(name=name), row, package, enums)
    pool = DescriptorPool()
    pool.Add(file)
    return {name: GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}")) for name in messages}


def _describe(message: DescriptorProto, row: Mapping[str, str], package: str, enums: Mapping[str, Any]) -> None:
    for number, (name, wanted) in enumerate(row.items(), start=1):
        bare = wanted.rstrip("?*")
        field = message.field.add(name=name, json_name=name, number=number)
        repeated = wanted.endswith("*")
        field.label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
        if bare in _SCALARS:
            field.type = _SCALARS[bare]
        else:
            field.type = FieldDescriptorProto.TYPE_ENUM if bare in enums else FieldDescriptorProto.TYPE_MESSAGE
            field.type_name = f".{package}.{bare}"
        if wanted.endswith("?") and field.type != FieldDescriptorProto.TYPE_MESSAGE:
            field.proto3_optional = True           # proto3 requires a oneof with this single field
            field.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{name}")


def _type_of(hint: Any) -> str:
    if get_origin(hint) is UnionType:
        return _type_of(next(one for one in get_args(hint) if one is not NoneType)) + "?"
    if get_origin(hint) is tuple:
        return _type_of(get_args(hint)[0]) + "*"
    return _OF_PYTHON.get(hint, getattr(hint, "__name__", "string"))


# ---------------------------------------------------------------------------------------------------------------------

PACKAGE: Final = "tdhil"

SAMPLE: Final = 1
COMMAND: Final = 2
CAN: Final = 3
STAGE: Final = 4
EXCITATION: Final = 5
EVENT: Final = 6
CONFIGURATION: Final = 7
RESULT: Final = 8
LOG: Final = 9
MODBUS: Final = 10
VIRTUAL_STRING: Final = 11
OTHER_FRAMES: Final = 12
FRF: Final = 13
LIVE_INERTIA: Final = 14

VIRTUAL_COLUMNS: Final = (
    "time_s", "phase", "set_rad_s", "top_rad_s", "innovation_rad_s", "string_nm", "drive_nm", "share", "bit_rad_s",
    "unknown_nm", "put_in_j", "clamped",
)
"""Values of a `VirtualString`, all doubles: those of `tdhil.soft_torque.HostLoop.row`."""

FRF_COLUMNS: Final = (
    "hertz", "magnitude", "magnitude_low", "magnitude_high", "phase_rad", "phase_rad_low", "phase_rad_high",
    "apparent_inertia_kg_m2", "noise_rel", "distortion_rel", "coherence",
)
"""Arrays of a `Response`, one value for each excited line: ω/T in rad/(s·N·m)."""

CHANNELS: Final = {
    SAMPLE: ("/sample", "Sample"),
    COMMAND: ("/command", "Command"),
    CAN: ("/can", "Frames"),
    STAGE: ("/stage", "Stage"),
    EXCITATION: ("/excitation", "Motion"),
    EVENT: ("/event", "Event"),
    CONFIGURATION: ("/configuration", "Text"),
    RESULT: ("/result", "Text"),
    LOG: ("/log", "Log"),
    MODBUS: ("/modbus", "Frames"),
    VIRTUAL_STRING: ("/virtual_string", "VirtualString"),
    OTHER_FRAMES: ("/frames", "Frames"),
    FRF: ("/frf", "Response"),
    LIVE_INERTIA: ("/live_inertia", "LiveInertia"),
}
FRAME_CHANNELS: Final = {topic: number for number, (topic, message) in CHANNELS.items() if message == "Frames"}
"""Channels of raw frames by topic. A log has messages on only one of them."""
RAW_FRAMES: Final = frozenset(FRAME_CHANNELS.values())

MODES: Final = {None: 0, Mode.SPEED: 1, Mode.TORQUE: 2}
MODE_OF: Final = {number: mode for mode, number in MODES.items()}
STATES: Final = {
    PowerState.NOT_READY: 0,
    PowerState.OFF: 1,
    PowerState.READY: 2,
    PowerState.ENABLED: 3,
    PowerState.QUICK_STOP: 4,
    PowerState.FAULT: 5,
    PowerState.UNKNOWN: 6,
    PowerState.FAULT_REACTION: 7,
}
STATE_OF: Final = {number: state for state, number in STATES.items()}

ENUMS: Final = {
    "Mode": ("OTHER", "SPEED", "TORQUE"),
    "State": tuple(state.name for state in STATES),
}
MESSAGES: Final = {
    "Sample": {
        "time_s": "double",
        "speed_rad_s": "double",
        "torque_nm": "double",
        "age_s": "double",
        "half_width_s": "double",
        "fresh": "bool",
        "limit_active": "bool",
        "standstill": "bool",
        "state": "State",
        "mode": "Mode",
        "status": "fixed32",
        "torque_demand_nm": "double?",
        "position_rad": "double?",
    },
    "Command": {"time_s": "double", "speed_rad_s": "double", "torque_nm": "double", "mode": "Mode",
                "torque_offset_nm": "double?"},
    "Frame": {"time_s": "double", "outgoing": "bool", "identifier": "fixed32", "data": "bytes"},
    "Frames": {"time_s": "double", "frames": "Frame*"},
    "Stage": fields_of(Stage),
    "Segment": fields_of(Segment),
    "Excitation": fields_of(Excitation),
    "Level": fields_of(Level),
    "Ramp": fields_of(Ramp),
    "Motion": {"excitation": "Excitation?", "levels": "Level*", "ramps": "Ramp*"},
    "Event": fields_of(Event),
    "Text": {"json": "string"},
    "VirtualString": dict.fromkeys(VIRTUAL_COLUMNS, "double"),
    "Response": dict.fromkeys(FRF_COLUMNS, "double*") | {"distortion_detected": "bool"},
    "LiveInertia": fields_of(LiveInertia),
}
CLASSES: Final[dict[str, Any]] = message_classes(PACKAGE, ENUMS, MESSAGES) | {"Log": LOG_CLASS}


def schema_name(message: str) -> str:
    """Return the full name of a message, such as ``tdhil.Sample``."""
    name: str = CLASSES[message].DESCRIPTOR.full_name
    return name
