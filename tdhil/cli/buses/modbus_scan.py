"""The Modbus lines of a scan: one for TCP, one after the other of the usual settings for a serial device."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from drivers import Clock, CommunicationLost, MonotonicClock, PreflightRefused, PreflightTable, SteppedClock
from drivers.modbus import (
    READ_HOLDING,
    READ_INPUT,
    BadReply,
    Link,
    NoReply,
    Parameters,
    RegisterAccess,
    check_name_plate,
    find_rated_torque,
    from_words,
    read,
    read_marker,
    settle,
)
from profiles import MessageCode, load_profile, profile_names, visible
from profiles.modbus import ModbusProfile, Register
from tdhil.cli.profile_text import register_uses
from tdhil.cli.scan_common import FoundDrive
from tdhil.config import DriveData, Origin, Setting
from tdhil.session import Connection
from tdhil.session.buses.modbus import SettingsRefused, config_of, open_line
from tdhil.session.buses.modbus_line import ModbusConfig

if TYPE_CHECKING:
    from tdhil.session import PeerPlan


# ---------------------------------------------------------------------------------------------------------------------
# The units of a Modbus line: a read of one register each, then the device identification and what the profiles expect.
#
# Reads only (functions 3, 4 and 43/14). Every answer shows a unit, also an exception.


ANSWER_S = 0.25
"""Timeout for one reply, s: at 9600 baud a request and its reply take 17 ms, and drives turn around in 5 to 100 ms."""
UNITS_TCP, UNITS_RTU = "1-5,255", "1-5"
BAUDS = (19200, 9600, 38400, 115200, 57600)
FORMATS = (("E", 1), ("N", 1), ("N", 2))
"""Usual factory settings of parity and stop bits, the most common first."""
_IDENTIFY = bytes((0x2B, 0x0E, 0x01, 0x00))
"""Function 43, MEI 14: read device identification, the basic stream (Modbus Application Protocol, section 6.21)."""


@dataclass(frozen=True)
class ProfileFit:
    """How well a profile suits a drive: whether all its registers answer and its name plate fits (None: it has
    none).
    """

    profile: str
    plate: bool | None
    named: bool                 # the drive's vendor name is the profile's vendor


def parse_units(text: str) -> tuple[int, ...]:
    """Parse ``1-5,247`` → 1 2 3 4 5 247. Raises ValueError for other text and numbers beyond 0 to 255."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        low, high = int(first), int(last if dash else first)
        if not 0 <= low <= high <= 255:
            raise ValueError(f"{part}: unit numbers are 0 to 255")
        found += range(low, high + 1)
    return tuple(dict.fromkeys(found))


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


def identify(link: Link, unit: int, transport: str, line: dict[str, Any]) -> FoundDrive:
    """Return name and profile of a unit that answered."""
    vendor, product, revision = device_identification(link, unit)
    said = " ".join(part for part in (vendor, product, revision) if part)
    plain = RegisterAccess(link, unit, "high_first", frozenset({READ_HOLDING}))
    simulated = False
    with contextlib.suppress(CommunicationLost):
        simulated = read_marker(plain).simulated
    fits = [fit for profile in _profiles(transport) if (fit := _fit(link, unit, profile, vendor)) is not None]
    profile, why = choose(fits)
    return FoundDrive("modbus", unit, product or vendor or "Modbus device", said or "unknown (function 43)", simulated,
                      profile, why, line=line)


def choose(fits: Sequence[ProfileFit]) -> tuple[str | None, str]:
    """Return (profile, reason): by name and name plate. Registers that only answer are no reason."""
    good = [fit for fit in fits if fit.plate is not False]
    ranked = sorted(good, key=lambda fit: (fit.plate is True, fit.named), reverse=True)
    if ranked and (ranked[0].plate or ranked[0].named):
        best = ranked[0]
        reasons = [text for text, holds in (
            ("the vendor's name", best.named), ("a name plate that fits P = T·ω", best.plate is True)) if holds]
        return best.profile, "all registers answer, and " + " and ".join(reasons)
    if good:
        names = ", ".join(fit.profile for fit in good)
        return None, f"the registers of {names} answer, which is no proof: choose by the drive's name plate"
    return None, "no profile fits, all have registers without an answer: copy profiles/generic/modbus.yaml and adapt it"


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


def _profiles(transport: str) -> list[ModbusProfile]:
    found = [profile for name in profile_names() if isinstance(profile := load_profile(name), ModbusProfile)]
    return [profile for profile in found if transport in profile.line.transports]


def _fit(link: Link, unit: int, profile: ModbusProfile, vendor: str) -> ProfileFit | None:
    """Return the fit; None if one of the profile's registers can't be read."""
    counts: dict[str, int] = {}
    access = RegisterAccess(link, unit, profile.line.word_order, frozenset(profile.cycle.functions))
    for use in register_uses(profile):
        try:
            raw = _read_once(access, use.register, profile)
        except (CommunicationLost, PreflightRefused):
            return None
        if use.name.startswith("parameters."):
            counts[use.name.partition(".")[2]] = raw
    maker = profile.name.partition("/")[0]
    return ProfileFit(profile.name, _plate(profile, counts), bool(vendor) and maker in vendor.lower())


def _read_once(access: RegisterAccess, register: Register, profile: ModbusProfile) -> int:
    """Read once, without the retries of a preflight: a scan reads many registers that do not exist."""
    function = READ_HOLDING if register.table == "holding" else READ_INPUT
    words = access.once(read(function, register.address, register.count), ANSWER_S).words
    return from_words(words, register.type, profile.line.word_order)


def _plate(profile: ModbusProfile, counts: dict[str, int]) -> bool | None:
    if profile.name_plate is None:
        return None
    table = PreflightTable()
    found = Parameters(counts, settle(profile, counts, {}))
    rated_nm = find_rated_torque(table, profile, found, None)
    if rated_nm is None and profile.parameter(profile.name_plate.torque).unit == "rated":
        return None
    table.checks.clear()
    check_name_plate(table, profile, found, rated_nm or 0.0)
    return bool(table.checks) and all(check.outcome.value == "ok" for check in table.checks)


# ---------------------------------------------------------------------------------------------------------------------

SCAN = "scan"
"""Source of a line setting that the scan tried."""


def scan_lines(
    plan: PeerPlan, connection: Connection, units: tuple[int, ...], say: Callable[[str], None]
) -> tuple[tuple[FoundDrive, ...], list[str]]:
    """Return all units at the first line setting with an answer. Raises CommunicationLost without any answer."""
    garbled = tried = 0
    where = ""
    refused: SettingsRefused | None = None
    for setting in _settings(plan, config_of(connection)):
        clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
        try:
            with open_line(plan, replace(connection, line=setting), DriveData(), clock) as line:
                where = line.link.description
                if setting.serial is not None and not plan.embedded:
                    say(f"asking {len(units)} units at {setting.baud} baud 8{setting.parity}{setting.stop_bits} …")
                present, spoiled = probe(line.link, units)
                garbled, tried = garbled + spoiled, tried + 1
                if present:
                    transports = line.profile.line.transports
                    found = _identify(line.link, present, setting, transports[0] if plan.embedded else "")
                    return found, [f"{spoiled} replies could not be read"] if spoiled else []
        except SettingsRefused as error:
            refused = error                                # this adapter has no such setting; others may work
    if refused is not None and not tried:
        raise refused
    asked = f"units {', '.join(map(str, units))}" + (f" at {tried} settings of the line" if tried > 1 else "")
    if garbled:
        raise CommunicationLost(
            f"no readable answer ({asked}), but {garbled} garbled replies were received", where=where,
            next_step="Check baud rate and parity at the drive, the polarity of the wires, termination and shielding",
            entry=MessageCode.BAD_REPLY,
        )
    step = "Check the drive's unit number (--units 1-247 scans all), that Modbus TCP is on, and its address"
    if config_of(connection).serial is not None:
        step = "Check the drive's unit number (--units 1-247 scans all), baud rate, the two wires and their polarity"
    raise CommunicationLost(f"no unit answers ({asked})", where=where, next_step=step, entry=MessageCode.NO_REPLY)


def _identify(link: Link, units: list[int], setting: ModbusConfig, embedded: str) -> tuple[FoundDrive, ...]:
    """Identify the units. ``embedded``: the transport of an embedded simulator, '' of a real line."""
    transport = embedded or ("rtu" if setting.serial is not None else "tcp")
    serial = not embedded and setting.serial is not None
    names = ("serial", "baud", "parity", "stop_bits") if serial else ("host", "port")
    known = {} if embedded else setting.settings
    values: dict[str, Any] = {name: known[name].value for name in names if name in known}
    return tuple(identify(link, unit, transport, values) for unit in units)


def _settings(plan: PeerPlan, line: ModbusConfig) -> Iterator[ModbusConfig]:
    """Yield the given settings first; on a serial line then the usual ones for settings that are not given."""
    yield line
    if plan.embedded or line.serial is None:
        return
    bauds = (line.baud,) if _said(line, "baud") else BAUDS
    parities = tuple(
        (parity, stops) for parity, stops in FORMATS
        if (not _said(line, "parity") or parity == line.parity) and (not _said(line, "stop_bits")
                                                                     or stops == line.stop_bits)
    )
    for baud in bauds:
        for parity, stops in parities:
            if (baud, parity, stops) != (line.baud, line.parity, line.stop_bits):
                changed = {"baud": baud, "parity": parity, "stop_bits": stops}
                yield ModbusConfig(MappingProxyType(
                    {**line.settings, **{name: Setting(value, SCAN, Origin.SCAN) for name, value in changed.items()}}
                ))


def _said(line: ModbusConfig, name: str) -> bool:
    """Return whether it is given on the command line or in rig.yaml, not by the profile."""
    return line.origin(name) in (Origin.COMMAND_LINE, Origin.RIG_FILE)
