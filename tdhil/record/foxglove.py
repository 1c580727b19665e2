"""Events once more as `foxglove.Log`, which viewers of MCAP show as a log (docs.foxglove.dev, schema Log).

Our own Event stays what is read back; this one is for people with a viewer, and nothing here reads it.
"""

from typing import Any, Final

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP

from tdhil.record.event import FAILURE, INTERRUPTED, RECOVERED

_LEVELS: Final = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
_INFO, _WARNING, _ERROR = 2, 3, 4
_WARNINGS: Final = frozenset({
    INTERRUPTED, RECOVERED, "bus", "clock", "dropped", "fault", "left", "limits", "stop", "warning", "watchdog",
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
    """A `foxglove.Log` message of an event; its level is by the event's kind."""
    level = _ERROR if kind == FAILURE else _WARNING if kind in _WARNINGS else _INFO
    message = LOG_CLASS(level=level, message=f"{kind}: {text}", name=_NAME)
    message.timestamp.seconds, message.timestamp.nanos = divmod(log_time_ns, 10**9)
    payload: bytes = message.SerializeToString()
    return payload
