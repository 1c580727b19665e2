"""Fast reading of many chunks by numpy: the places of their records and the values of their samples.

A log of tdhil has a chunk each 0.2 s of control time, with some 150 records. Reading them record by record in Python
takes most of the time. Here all chunks of a batch are read in parallel: the k-th records of all of them together. This
module only reads the exact layout of tdhil's writer; for any other layout the caller reads message by message. Pure;
the bytes may be hostile, and no index is trusted.
"""

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tdhil.recording.log_messages import (
    COMMAND_SIZE,
    DEMAND_TAG,
    ENABLED_STATE,
    MORE_SIZE,
    OFFSET_TAG,
    POSITION_TAG,
    SAMPLE_SIZE,
    TORQUE_MODE,
)
from tdhil.recording.mcap_records import CHANNEL, MESSAGE, MESSAGE_HEAD, RECORD_HEAD, SCHEMA

_MESSAGE_SIZE: Final = MESSAGE_HEAD.size
_FEW: Final = 12                       # chunks; for fewer, a loop in Python is faster than numpy
_DECLARING: Final = (SCHEMA, CHANNEL)

_HEAD_ROW: Final = np.dtype([("opcode", "u1"), ("length", "<u8")])
_MESSAGE_ROW: Final = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time_ns", "<u8")])
_SAMPLE_ROW: Final = np.dtype([
    ("tag1", "u1"), ("time_s", "<f8"), ("tag2", "u1"), ("speed_rad_s", "<f8"), ("tag3", "u1"), ("torque_nm", "<f8"),
    ("tag4", "u1"), ("age_s", "<f8"), ("tag5", "u1"), ("half_width_s", "<f8"), ("tag6", "u1"), ("fresh", "u1"),
    ("tag7", "u1"), ("limit_active", "u1"), ("tag8", "u1"), ("standstill", "u1"), ("tag9", "u1"), ("state", "u1"),
    ("tag10", "u1"), ("mode", "u1"), ("tag11", "u1"), ("status", "<u4"),
])
"""Layout of `log_messages.pack_sample`, byte by byte; torque demand and position may follow, each with its tag."""
_TAGS: Final = tuple(
    zip((f"tag{k}" for k in range(1, 12)), (0x09, 0x11, 0x19, 0x21, 0x29, 0x30, 0x38, 0x40, 0x48, 0x50, 0x5D),
        strict=True))
_VARINTS: Final = ("fresh", "limit_active", "standstill", "state", "mode")
_COMMAND_ROW: Final = np.dtype([
    ("tag1", "u1"), ("time_s", "<f8"), ("tag2", "u1"), ("speed_rad_s", "<f8"), ("tag3", "u1"), ("torque_nm", "<f8"),
    ("tag4", "u1"), ("mode", "u1"),
])
"""Layout of `log_messages.pack_command`, byte by byte; the torque offset may follow, with its tag."""
_COMMAND_TAGS: Final = tuple(zip((f"tag{k}" for k in range(1, 5)), (0x09, 0x11, 0x19, 0x20), strict=True))
_MORE_ROW: Final = np.dtype([("tag", "u1"), ("value", "<f8")])

Offsets = NDArray[np.int64]


class TorqueCommand(NamedTuple):
    """Time of a command, s, and its torque setpoint, N·m; NaN if it requested another mode than torque."""

    time_s: float
    torque_nm: float


NO_COMMAND: Final = TorqueCommand(math.nan, math.nan)


@dataclass(frozen=True)
class SampleBlock:
    """Samples in their order: ``values`` (n, 3) time in s, speed in rad/s, torque in N·m; fresh and limited, (n,).

    ``setpoints`` (n, 2): commanded and demanded torque, N·m, as `RecordingBuilder.add` takes them. ``position_rad``: of
    the samples ``positions_at``, counted from the block's first.
    """

    values: NDArray[np.float64]
    fresh: NDArray[np.bool_]
    limited: NDArray[np.bool_]
    setpoints: NDArray[np.float64]
    positions_at: NDArray[np.int64]
    position_rad: NDArray[np.float64]
    first_log_time_ns: int


@dataclass(frozen=True)
class RawMessage:
    """One message of a chunk, not decoded yet."""

    number: int
    payload: bytes


class ChunkTable:
    """Records of several chunks, one after the other.

    ``plain``: for each chunk, True if it contains only complete messages.
    """

    def __init__(self, chunks: Sequence[bytes]) -> None:
        self._data = b"".join(chunks)
        ends = np.cumsum([len(chunk) for chunk in chunks], dtype=np.int64)
        starts = np.concatenate((np.zeros(1, np.int64), ends[:-1]))
        at, opcode, length, whole = _records(self._data, starts, ends)
        chunk_of = np.searchsorted(ends, at, side="right")
        odd = ((opcode == MESSAGE) & (length < _MESSAGE_SIZE)) | np.isin(opcode, _DECLARING)
        whole[chunk_of[odd]] = False
        self.plain: tuple[bool, ...] = tuple(whole.tolist())
        kept = opcode == MESSAGE
        self._at, self._length = at[kept] + RECORD_HEAD.size, length[kept]
        self._rows = np.searchsorted(self._at, np.concatenate((starts, ends[-1:])))

    def messages(
        self, first: int, last: int, numbers: Mapping[int, int], samples: int, commands: int, skipped: frozenset[int],
        before: TorqueCommand,
    ) -> tuple[SampleBlock | None, TorqueCommand, list[RawMessage], bool] | None:
        """Return the samples of the plain chunks from ``first`` to before ``last``, the last command, the other
        messages, and whether any message is tdhil's.

        ``numbers``: tdhil's channel number by the file's; ``samples``, ``commands``: numbers of these channels;
        ``skipped``: channels to leave out; ``before``: the last command before these chunks. Returns None if a sample
        or a command does not have the exact layout of tdhil's writer.
        """
        rows = slice(self._rows[first], self._rows[last])
        at, length = self._at[rows], self._length[rows]
        known = np.zeros(2**16, np.uint8)
        for channel, number in numbers.items():
            known[channel] = number
        head = _taken(self._data, at, _MESSAGE_ROW)
        number_of = known[head["channel"]]
        is_sample, is_command = number_of == samples, number_of == commands
        commanded = self._commands(at[is_command], length[is_command], before)
        if commanded is None:
            return None
        block = None
        if is_sample.any():
            # row 0 is the command before these chunks, so the number of commands before a sample is the row of its
            # command
            answered = commanded[np.cumsum(is_command)[is_sample]]
            block = self._samples(
                at[is_sample], length[is_sample], answered, int(head["log_time_ns"][np.argmax(is_sample)]))
            if block is None:
                return None
        others = np.flatnonzero((number_of != 0) & ~is_sample & ~is_command & ~np.isin(number_of, tuple(skipped)))
        found = [
            RawMessage(int(number_of[k]), self._data[at[k] + _MESSAGE_SIZE:at[k] + length[k]]) for k in others.tolist()
        ]
        return block, TorqueCommand(*commanded[-1].tolist()), found, bool(number_of.any())

    def _commands(self, at: Offsets, length: Offsets, before: TorqueCommand) -> NDArray[np.float64] | None:
        """Return (1 + n, 2) time and torque setpoint (NaN: not in torque mode) of ``before`` and of n commands."""
        size = length - _MESSAGE_SIZE
        more = size == COMMAND_SIZE + MORE_SIZE
        if not np.all(more | (size == COMMAND_SIZE)):
            return None
        rows = _taken(self._data, at + _MESSAGE_SIZE, _COMMAND_ROW)
        exact = bool(all((rows[name] == tag).all() for name, tag in _COMMAND_TAGS) and (rows["mode"] < 0x80).all())
        if exact and more.any():
            data = np.frombuffer(self._data, np.uint8)
            exact = bool((data[at[more] + _MESSAGE_SIZE + COMMAND_SIZE] == OFFSET_TAG).all())
        if not exact:
            return None
        found = np.empty((1 + len(rows), 2))
        found[0] = before
        found[1:, 0] = rows["time_s"]
        found[1:, 1] = np.where(rows["mode"] == TORQUE_MODE, rows["torque_nm"], np.nan)
        return found

    def _samples(
        self, at: Offsets, length: Offsets, answered: NDArray[np.float64], log_time_ns: int
    ) -> SampleBlock | None:
        size = length - _MESSAGE_SIZE
        more = (size - SAMPLE_SIZE) // MORE_SIZE
        if not np.all((size == SAMPLE_SIZE + more * MORE_SIZE) & (more >= 0) & (more <= 2)):
            return None
        rows = _taken(self._data, at + _MESSAGE_SIZE, _SAMPLE_ROW)
        exact = all((rows[name] == tag).all() for name, tag in _TAGS) and all(
            (rows[name] < 0x80).all() for name in _VARINTS)
        one, two = np.flatnonzero(more == 1), np.flatnonzero(more == 2)
        behind = at + (_MESSAGE_SIZE + SAMPLE_SIZE)
        single, first = _taken(self._data, behind[one], _MORE_ROW), _taken(self._data, behind[two], _MORE_ROW)
        second = _taken(self._data, behind[two] + MORE_SIZE, _MORE_ROW)
        exact = (
            exact and bool(np.isin(single["tag"], (DEMAND_TAG, POSITION_TAG)).all())
            and bool((first["tag"] == DEMAND_TAG).all()) and bool((second["tag"] == POSITION_TAG).all())
        )
        if not exact:
            return None
        alone = single["tag"] == POSITION_TAG
        positions_at = np.concatenate((one[alone], two))
        position_rad = np.concatenate((single["value"][alone], second["value"]))
        values = np.empty((len(rows), 3))
        for column, name in enumerate(("time_s", "speed_rad_s", "torque_nm")):
            values[:, column] = rows[name]
        enabled = rows["state"] == ENABLED_STATE
        in_torque = enabled & (rows["mode"] == TORQUE_MODE) & (answered[:, 0] == rows["time_s"])
        setpoints = np.full((len(rows), 2), np.nan)
        setpoints[in_torque, 0] = answered[in_torque, 1]
        setpoints[one[~alone], 1] = single["value"][~alone]
        setpoints[two, 1] = first["value"]
        setpoints[~enabled, 1] = np.nan
        return SampleBlock(
            values, rows["fresh"] != 0, rows["limit_active"] != 0, setpoints, positions_at, position_rad, log_time_ns
        )


def _taken(data: bytes, at: Offsets, row: np.dtype[np.void]) -> NDArray[np.void]:
    """Return a copy of the rows that begin at these bytes; each must lie within ``data``."""
    if not len(at):
        return np.empty(0, row)
    # as plain bytes, which are copied in one step; fields would be copied one by one
    everywhere: NDArray[np.void] = np.ndarray((len(data) - row.itemsize + 1,), f"V{row.itemsize}", data, strides=(1,))
    return everywhere[at].view(row)


def _records(
    data: bytes, starts: Offsets, ends: Offsets
) -> tuple[Offsets, NDArray[np.uint8], Offsets, NDArray[np.bool_]]:
    """Return start, opcode and length of each record, in the order of ``data``; and whether each chunk is whole."""
    whole = np.ones(len(starts), np.bool_)
    places, opcodes, lengths = [], [], []
    chunk = np.flatnonzero(starts < ends)
    at, last = starts[chunk], ends[chunk] - RECORD_HEAD.size          # last possible place of a record's head
    while len(chunk) >= _FEW:
        room = last - at
        if room.min() < 0:
            going = room >= 0
            whole[chunk[(room < 0) & (room > -RECORD_HEAD.size)]] = False
            chunk, at, last = chunk[going], at[going], last[going]
            continue
        head = _taken(data, at, _HEAD_ROW)
        fits = head["length"] <= room.view(np.uint64)
        if not fits.all():
            whole[chunk[~fits]] = False
            chunk, at, last, head = chunk[fits], at[fits], last[fits], head[fits]
        length = head["length"].astype(np.int64)
        places.append(at)
        opcodes.append(head["opcode"])
        lengths.append(length)
        at = at + (length + RECORD_HEAD.size)
    for one, start in zip(chunk.tolist(), at.tolist(), strict=True):
        found, whole[one] = _walk(data, start, int(ends[one]))
        if found:
            table = np.frombuffer(found, np.int64).reshape(-1, 3)
            places.append(table[:, 0])
            opcodes.append(table[:, 1].astype(np.uint8))
            lengths.append(table[:, 2])
    if not places:
        none = np.empty(0, np.int64)
        return none, none.astype(np.uint8), none, whole
    every = np.concatenate(places)
    order = np.argsort(every, kind="stable")
    return every[order], np.concatenate(opcodes)[order], np.concatenate(lengths)[order], whole


def _walk(data: bytes, at: int, end: int) -> "tuple[array[int], bool]":
    """Return place, opcode, length, place, … of one chunk's records, read one by one; and whether the chunk is
    whole.
    """
    found = array("q")
    unpack, head = RECORD_HEAD.unpack_from, RECORD_HEAD.size
    while at < end:
        if at + head > end:
            return found, False
        opcode, length = unpack(data, at)
        after = at + head + length
        if after > end:
            return found, False
        found.extend((at, opcode, length))
        at = after
    return found, True
