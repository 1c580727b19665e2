"""The units of a Modbus line: a read of one register each, then the device identification.

Reads only (functions 3 and 43/14). Every answer shows a unit, also an exception.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from drivers.modbus.link import Link
from drivers.modbus.pdu import READ_HOLDING, BadReply, NoReply, read
from profiles import visible

ANSWER_S: Final = 0.25
"""Timeout for one reply, s: at 9600 baud a request and its reply take 17 ms, and drives turn around in 5 to 100 ms."""
_IDENTIFY: Final = bytes((0x2B, 0x0E, 0x01, 0x00))
"""Function 43, MEI 14: read device identification, the basic stream (Modbus Application Protocol, section 6.21)."""


def probe(link: Link, units: Iterable[int]) -> tuple[list[int], int]:
    """Return (units that answer, number of unreadable replies). Raises LinkLost if the line is lost."""
    present, garbled = [], 0
    for unit in units:
        try:
            link.transact(unit, read(READ_HOLDING, 0, 1), ANSWER_S)
            present.append(unit)
        except NoReply:
            continue
        except BadReply:
            garbled += 1
    return present, garbled


def device_identification(link: Link, unit: int) -> tuple[str, str, str]:
    """Return vendor, product code and revision by function 43; empty if the drive does not support it."""
    try:
        pdu = link.transact(unit, _IDENTIFY, ANSWER_S).pdu
    except (NoReply, BadReply):
        return "", "", ""
    return parse_identification(pdu)


def parse_identification(pdu: bytes) -> tuple[str, str, str]:
    """Parse a reply of function 43/14: 2B 0E 01 conformity more next count, then id, length, text of each object."""
    found = {0: "", 1: "", 2: ""}
    if len(pdu) < 7 or pdu[:2] != _IDENTIFY[:2]:
        return "", "", ""
    at = 7
    for _ in range(pdu[6]):
        if at + 2 > len(pdu):
            break
        number, length = pdu[at], pdu[at + 1]
        found[number] = visible(pdu[at + 2 : at + 2 + length].decode("ascii", "replace").strip())
        at += 2 + length
    return found[0], found[1], found[2]
