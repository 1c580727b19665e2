"""Protobuf message classes from a compact table: no compiler, no generated code, any protobuf runtime from 5 on.

A message is a dictionary from field name to type; the field's number is its place, counted from 1. So fields
are added at the end and never moved. A type is a scalar of protobuf, an enum or a message of the same table,
with ``?`` for an optional one (absent is not zero) and ``*`` for a repeated one.
"""

from collections.abc import Mapping
from dataclasses import fields
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from tdhil.record.plain import hints_of

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
    """The table row of a dataclass, from its annotations."""
    hints = hints_of(kind)
    return {field.name: _type_of(hints[field.name]) for field in fields(kind)}


def message_classes(package: str, enums: Mapping[str, tuple[str, ...]], messages: Table) -> dict[str, Any]:
    """A class for each message of the table; the values of an enum count from 0."""
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
            field.proto3_optional = True           # proto3 wants a oneof of one for it
            field.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{name}")


def _type_of(hint: Any) -> str:
    if get_origin(hint) is UnionType:
        return _type_of(next(one for one in get_args(hint) if one is not NoneType)) + "?"
    if get_origin(hint) is tuple:
        return _type_of(get_args(hint)[0]) + "*"
    return _OF_PYTHON.get(hint, getattr(hint, "__name__", "string"))
