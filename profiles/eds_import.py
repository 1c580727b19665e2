"""Begins a CANopen profile from an EDS or DCF. Entries that the file does not contain are marked unverified.

Names and numbers come from the file, all other words are our own. If the file leaves a point open, the safer value is
written: no change of mode while enabled, speed mode before a quick stop, and a drive that coasts.
"""

import math
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass

from profiles.canopen import CanopenProfile
from profiles.eds_reader import EdsFile, EdsObject
from profiles.entry import Confidence
from profiles.errors import DataFileError, Problem
from profiles.yaml_loader import parse_model

SPEED_MODES, TORQUE_MODES = (9, 3), (10, 4)
"""Codes of 6060h that tdhil supports, the preferred one first."""
_MUST = {
    0x6040: ("controlword", "u16"), 0x6041: ("statusword", "u16"), 0x60FF: ("target velocity", "i32"),
    0x606C: ("velocity actual", "i32"),
}
_MUST_VL = {key: _MUST[key] for key in (0x6040, 0x6041)} | {
    0x6042: ("vl target velocity", "i16"), 0x6044: ("vl velocity actual", "i16"),
}
"""Required entries of a drive that has velocity mode (vl, 2) instead."""
_ROTATIONS = {0xB4: 1.0, 0x10: 1.0 / (2.0 * math.pi), 0x41: 1.0 / 360.0}
_TIMES_S = {0x03: 1.0, 0x47: 60.0}
"""Turns in the numerators, and seconds in the denominators, of the units of 60A9h, by their numbers in CiA 303-2. B4h,
a revolution, is of CiA 402."""
_KEEP_MODE = "CiA 402-2 leaves open whether 6060h may change while the drive is enabled"


@dataclass(frozen=True)
class Begun:
    """A profile as text and as the parsed model."""

    text: str
    profile: CanopenProfile


def begin_profile(eds: EdsFile, path: str) -> Begun:
    """Return the profile that an EDS or DCF allows; ``path`` is for messages.

    Raises DataFileError if the file does not describe a CiA 402 drive that tdhil can use.
    """
    problems = []
    kind = eds.get(0x1000)
    told = None if kind is None else kind.stands
    if kind is not None and told is not None and int(told) & 0xFFFF not in (0, 402):
        problems.append(Problem(path, kind.line, f"1000h says device profile {int(told) & 0xFFFF}: no CiA 402 drive"))
    must = _MUST_VL if _only_vl(eds) else _MUST
    if missing := [f"{index:04X}h ({said})" for index, (said, _) in must.items() if eds.get(index) is None]:
        problems.append(Problem(path, 0, f"has no {', '.join(missing)}: no CiA 402 drive with a speed to set"))
    for index, (said, kind_wanted) in must.items():
        one = eds.get(index)
        if one is not None and one.type != kind_wanted:
            problems.append(Problem(path, one.line, f"{index:04X}h ({said}) is {one.type}: must be {kind_wanted}"))
    if problems:
        raise DataFileError(tuple(problems))
    text = "\n".join(_Writer(eds).lines()) + "\n"
    return Begun(text, parse_model(text, path, CanopenProfile))


def _modes_told(eds: EdsFile) -> int | None:
    """Return 6502h; None if the file gives no value."""
    one = eds.get(0x6502)
    return None if one is None or not one.stands else int(one.stands)


def _only_vl(eds: EdsFile) -> bool:
    """Return whether velocity mode (2) is the only speed mode, by 6502h or else by the objects in the file."""
    if eds.get(0x6042) is None:
        return False
    bits = _modes_told(eds)
    if bits is not None and not any(bits >> code - 1 & 1 for code in SPEED_MODES):
        return bool(bits >> 1 & 1)
    return eds.get(0x60FF) is None


class _Writer:
    """Writer of the profile's sections. Each states the entries of the file, and what to look up in the manual."""

    def __init__(self, eds: EdsFile) -> None:
        self._eds = eds
        self._file = _plain(eds.name)
        self._parameters: list[str] = []
        self._hints: list[str] = []
        self._torque_modes: tuple[int, ...] = ()

    def lines(self) -> Iterator[str]:
        vendor, product = _plain(self._eds.vendor_name), _plain(self._eds.product_name)
        title = " ".join(part for part in (vendor, product) if part) or "CANopen drive"
        yield from _comment(
            f"Begun from {self._file} by `tdhil profiles import`. What an EDS can't know is marked unverified, with "
            "what to look for in the drive's manual: correct it, then change its confidence to verified and its "
            "source to the manual's page. A wrong unit here is a wrong moment of inertia later. "
            "The keys are explained in profiles/generic/cia402.yaml and docs/reference/profiles.md."
        )
        yield ""
        yield f"name: {_slug(vendor) or 'vendor'}/{_slug(product) or _slug(self._file.rpartition('.')[0]) or 'drive'}"
        yield f"title: {_quoted(f'{title} (CANopen), from its {self._kind}')}"
        yield "bus: canopen"
        yield "eds: null"
        yield f"node: {self._eds.node or 1}"
        for part in (self._identity, self._modes, self._quick_stop, self._speed, self._torque, self._watchdog,
                     self._cyclic):
            yield ""
            yield from part()
        yield ""
        yield from _comment(
            "Smoothing that the drive puts on the reported speed and torque: no EDS tells it. Look for filter, "
            "smoothing or averaging of the actual speed and torque; an example stands in "
            "profiles/generic/cia402.yaml."
        )
        yield "filters: []"
        if self._parameters:
            yield ""
            yield "parameters:"
            yield from self._parameters
        self._mapping_hints()
        if self._hints:
            yield ""
            yield "hints:"
            yield from (f"  - {_quoted(hint)}" for hint in self._hints)

    @property
    def _kind(self) -> str:
        return "DCF" if self._file.lower().endswith(".dcf") else "EDS"

    def _entry(self, said: str, confidence: Confidence) -> Iterator[str]:
        yield f"  source: {_quoted(said)}"
        yield f"  confidence: {confidence}"

    def _identity(self) -> Iterator[str]:
        found: dict[str, int | None] = {}
        for sub, part, other in ((1, "vendor", self._eds.vendor), (2, "product", self._eds.product),
                                 (3, "revision", None)):
            one = self._eds.get(0x1018, sub)
            told = None if one is None else one.stands
            found[part] = int(told) if told and 0 < told <= 0xFFFF_FFFF else other
        yield from _comment(
            "Object 1018h: preflight refuses any other drive at this node. The revision changes with the firmware: "
            "unchecked."
        )
        if found["revision"] is not None:
            yield from _comment(f"The file's revision is {found['revision']:08X}h.")
        yield "identity:"
        for part in ("vendor", "product"):
            value = found[part]
            yield f"  {part}: {'null' if value is None else f'0x{value:08X}'}"
        yield "  revision: null"
        if found["vendor"] is None:
            yield from self._entry(f"{self._file} names no vendor: tdhil scan shows the drive's", "unverified")
        else:
            yield from self._entry(f"{self._file}, 1018h or DeviceInfo; preflight compares the drive's", "verified")

    def _modes(self) -> Iterator[str]:
        mode, bits, vl = self._eds.get(0x6060), _modes_told(self._eds), _only_vl(self._eds)
        said = "no value of 6502h" if bits is None else f"6502h = {bits:08X}h"

        def has(code: int) -> bool:
            return bits is None or bool(bits >> code - 1 & 1)

        speed = [code for code in SPEED_MODES if has(code)]
        torque = [code for code in TORQUE_MODES if has(code)]
        mapped = mode is not None and mode.mappable
        target = self._eds.get(0x6071)
        why = ""
        if vl:
            speed, why = [2], "velocity mode (vl, 2) has its setpoint where other modes don't, and stands alone"
        elif target is None or target.type != "i16" or not target.mappable:
            why = "6071h (target torque) is not in the file, is no i16 or can't be mapped"
        elif not mapped:
            why = "6060h can't be mapped into a PDO: the mode can't change in the cycle"
        elif not torque:
            why = "6502h names no torque mode"
        if why:
            torque = []
        self._torque_modes = tuple(torque)
        yield from _comment(
            "9 cyclic synchronous velocity, 3 profile velocity, 10 cyclic synchronous torque, 4 profile torque; "
            "preferred first. Look for: modes of operation, 6060h, changing the mode. Say true only where the manual"
            " allows a change while operation is enabled: without it only the speed-mode variant of a run is "
            "possible."
        )
        if not speed:
            yield from _comment(f"{said} names neither 9 nor 3: mode 3 stands here for want of a better one.")
        if why:
            yield from _comment(f"No torque mode: {why}.")
        yield "modes:"
        yield f"  speed: {speed or [3]}"
        yield f"  torque: {torque}"
        yield "  switch_while_enabled: false"
        yield f"  mapped: {'true' if mapped else 'false'}"
        yield from self._entry(f"{self._file}, {said}; {_KEEP_MODE}", "unverified")

    def _quick_stop(self) -> Iterator[str]:
        option, ramp = self._writable(0x605A, "i16"), self._ramp(0x6085)
        stays = option is not None and option.takes(6)
        yield from _comment(
            "Bit 2 of the controlword. Look for: quick stop option code (605Ah; 6 = down on the quick-stop ramp, "
            "then hold the shaft), the unit of 6085h, and what a quick stop does in a torque mode."
        )
        if option is not None and option.stands is not None:
            yield from _comment(f"The file's 605Ah is {int(option.stands)}.")
        if not stays:
            yield from _comment(
                "605Ah is not in the file, or does not accept 6: tdhil assumes that the drive releases the shaft at "
                "standstill."
            )
        if ramp is None:
            yield from _comment(
                "6085h isn't written: it isn't in the file, or its unit isn't known, and a ramp in the wrong unit is a "
                "stop that lasts for minutes. Set the quick-stop ramp at the drive by hand, or look its unit up."
            )
        yield "quick_stop:"
        yield f"  option_code: {6 if stays else 'null'}"
        yield f"  deceleration_rpm_s_per_lsb: {ramp or 'null'}"
        yield "  decelerates_in_torque_mode: false"
        yield f"  ends: {'quick_stop' if stays else 'off'}"
        yield from self._entry(f"{self._file}, 605Ah and 6085h as far as they are there; their unit and effect are not",
                               "unverified")

    def _speed(self) -> Iterator[str]:
        si = self._si_unit()
        limit = self._writable(0x6080, "u32")
        yield from _comment(
            "Unit of 606Ch and 60FFh, and of the ramps. Look for: velocity unit, factor group, scaling, 60A9h, "
            "6096h."
        )
        scale: list[str] = []
        said, unit = "", 0
        confidence: Confidence = "unverified"
        if si is not None:
            unit = int(self._eds.objects[0x60A9, 0].stands or 0)
            said, confidence = f"{self._file}, 60A9h = {unit:08X}h, which preflight reads back", "likely"
            yield from _comment(
                "60A9h says what one count is; that the ramps follow it and 6080h is in rpm is the standard's."
            )
        else:
            scale, said = self._scale()
            yield from _comment(
                "The file doesn't say it. Common are 1 rpm, 0.1 rpm, 0.001 rpm, and encoder counts a second."
            )
        for note in self._factors():
            yield from _comment(f"{note}")
        vl = _only_vl(self._eds)
        if vl:
            yield from _comment("Velocity mode: 6042h and 6044h, in rpm where 604Ch (vl dimension factor) is 1 over 1.")
        yield "speed:"
        if vl:
            yield "  vl: true"
        yield f"  rpm_per_lsb: {self._rpm_text()}"
        yield from scale
        if si is not None:
            yield f"  si_unit: 0x{unit:08X}"
        yield f"  max_motor_speed_rpm_per_lsb: {'null' if limit is None else '1.0'}"
        yield f"  acceleration_rpm_s_per_lsb: {self._ramp(0x6083) or 'null'}"
        yield f"  deceleration_rpm_s_per_lsb: {self._ramp(0x6084) or 'null'}"
        yield from self._entry(said, confidence)

    def _si_unit(self) -> float | None:
        """Return rpm for one count by 60A9h; None if the file does not state it, for another unit than of speed, or for
        vl mode.
        """
        one = self._eds.get(0x60A9)
        if _only_vl(self._eds) or one is None or one.type != "u32" or not one.readable or not one.stands:
            return None
        raw = int(one.stands)
        turn, second = _ROTATIONS.get(raw >> 16 & 0xFF), _TIMES_S.get(raw >> 8 & 0xFF)
        power = (raw >> 24 & 0xFF) - (0x100 if raw >> 31 & 1 else 0)
        if turn is None or second is None or raw & 0xFF or abs(power) > 9:
            return None
        return 60.0 * turn / second * 10.0 ** power

    def _rpm_text(self) -> str:
        found = self._si_unit()
        if found is not None:
            return f"{found:.12g}" if "." in f"{found:.12g}" or "e" in f"{found:.12g}" else f"{found:.12g}.0"
        return "60.0" if self._counted() else "1.0"

    def _ramp(self, index: int) -> str | None:
        """Return rpm/s for one count of a ramp, if the file states the unit of the speed; None: leave the ramp as it
        is.
        """
        return self._rpm_text() if self._si_unit() is not None and self._writable(index, "u32") is not None else None

    def _counted(self) -> bool:
        """Return whether the drive has an encoder resolution for the unit of speed."""
        one = self._eds.get(0x608F, 1)
        return not _only_vl(self._eds) and one is not None and one.type == "u32" and one.readable

    def _scale(self) -> tuple[list[str], str]:
        """Return (the lines of times and over, source). It is a guess that the drive's own objects are the scale."""
        if not self._counted():
            return [], f"{self._file} says nothing of the unit: 1 rpm is a guess"
        times, over = [], [self._scaling("encoder_increments", 0x608F, 1, "Position encoder resolution, increments")]
        if self._fits(0x608F, 2):
            times.append(self._scaling("encoder_revolutions", 0x608F, 2, "Position encoder resolution, revolutions"))
        said = "60FFh is taken for encoder increments a second (608Fh), a guess"
        if self._fits(0x6094, 1) and self._fits(0x6094, 2):
            times.append(self._scaling("velocity_numerator", 0x6094, 1, "Velocity encoder factor, numerator"))
            over.append(self._scaling("velocity_divisor", 0x6094, 2, "Velocity encoder factor, divisor"))
            said = "60FFh x 6094h is taken for encoder increments a second (608Fh), a guess"
        lines = [f"  times: [{', '.join(times)}]"] if times else []
        return [*lines, f"  over: [{', '.join(over)}]"], f"{self._file} says nothing of the unit: {said}"

    def _fits(self, index: int, sub: int) -> bool:
        one = self._eds.get(index, sub)
        return one is not None and one.type == "u32" and one.readable

    def _scaling(self, name: str, index: int, sub: int, title: str) -> str:
        """Add a parameter that scales the speed. Return its name."""
        told = self._eds.objects[index, sub].stands
        self._parameters += [
            f"  - name: {name}", f"    title: {_quoted(f'{index:04X}h:{sub} {title}')}", f"    index: 0x{index:04X}",
            f"    sub: {sub}", "    type: u32",
        ]
        if told:
            self._parameters.append(f"    default: {int(told)}")
        self._parameters += [
            "    advice: Must not read 0; where the drive has no such object, say the unit of 60FFh in the profile",
            f"    source: {_quoted(f'{self._file}, {index:04X}h:{sub}')}", "    confidence: verified",
        ]
        return name

    def _factors(self) -> Iterator[str]:
        """Yield the file's factor group, to help find the unit."""
        for index, said in ((0x6090, "velocity encoder resolution"), (0x6091, "gear ratio"), (0x6092, "feed constant"),
                            (0x6094, "velocity encoder factor"), (0x6095, "velocity factor 1"),
                            (0x6096, "velocity factor"), (0x604C, "vl dimension factor"),
                            (0x608B, "velocity notation index"), (0x608C, "velocity dimension index"),
                            (0x60A8, "SI unit position")):
            subs = [one for (at, sub), one in sorted(self._eds.objects.items()) if at == index and (sub or index in (
                0x608B, 0x608C, 0x60A8))]
            told = ", ".join("not reported" if one.stands is None else f"{one.stands:.10g}" for one in subs)
            if subs:
                yield f"{index:04X}h, {said}: {told}."

    def _torque(self) -> Iterator[str]:
        rated, limit = self._eds.get(0x6076), self._writable(0x6072, "u16")
        demand, actual = self._eds.get(0x6074), self._eds.get(0x6077)
        slope = self._writable(0x6087, "u32")
        tells = rated is not None and rated.type == "u32" and rated.readable
        yield from _comment(
            "The standard has 6076h in mN·m and 6071h, 6072h, 6077h in thousandths of it; some drives have µN·m, or "
            "mean the rated current. Look for: motor rated torque, target torque, torque actual value, torque "
            "constant."
        )
        if tells and rated is not None and rated.stands:
            yield from _comment(
                f"The file's 6076h is {int(rated.stands)}: {rated.stands / 1000.0:g} N·m if that is mN·m."
            )
        elif not tells:
            yield from _comment(
                "6076h isn't in the file, or is no u32: say drive_data.rated_torque_nm in rig.yaml, from the name "
                "plate."
            )
        if limit is None:
            yield from _comment(
                "6072h isn't in the file, or is no u16 that can be written: look for the drive's own limit of torque"
                " or current, and describe it under parameters with set_to: torque_limit."
            )
        if actual is None or actual.type != "i16" or not actual.mappable:
            yield from _comment(
                "6077h isn't in the file, is no i16 or can't be mapped: without a torque of one instant with the "
                "speed there is no inertia. Look for another object that can be mapped, and name it as `actual`."
            )
            self._hints.append("By the file 6077h, the torque, can't be mapped: preflight refuses until "
                               "`torque.actual` names an object that can")
        yield "torque:"
        yield f"  rated_torque_nm_per_lsb: {'0.001' if tells else 'null'}"
        yield "  rated_per_lsb: 0.001"
        yield f"  max_torque_rated_per_lsb: {'null' if limit is None else '0.001'}"
        yield f"  slope_rated_s_per_lsb: {'null' if slope is None else '0.001'}"
        yield f"  has_demand: {'true' if demand is not None and demand.type == 'i16' and demand.mappable else 'false'}"
        yield from self._entry(f"{self._file} for the objects that exist; CiA 402-2 for the units", "unverified")

    def _watchdog(self) -> Iterator[str]:
        consumer, guard, factor = self._eds.get(0x1016, 1), self._writable(0x100C, "u16"), self._writable(0x100D, "u8")
        reaction = self._writable(0x6007, "i16")
        stops = reaction is not None and reaction.takes(3)
        kind = "none"
        if consumer is not None and consumer.type == "u32" and consumer.writable:
            kind = "heartbeat"
        elif guard is not None and factor is not None:
            kind = "node_guarding"
        yield from _comment(
            "What brakes the shaft when this program, the computer or the cable fails. Look for: heartbeat consumer,"
            " life guarding, abort connection option code (6007h; 3 = quick stop), reaction to a lost bus."
        )
        if kind == "none":
            yield from _comment(
                "Neither 1016h nor 100Ch with 100Dh can be written: such a drive is refused but by name. Look for a "
                "watchdog of the maker's own."
            )
        elif reaction is not None and reaction.stands is not None:
            yield from _comment(f"The file's 6007h is {int(reaction.stands)}.")
        if kind != "none" and not stops:
            yield from _comment(
                "6007h isn't in the file, or doesn't take 3: the worst is written here until the manual says better."
            )
        yield "watchdog:"
        yield f"  kind: {kind}"
        if kind != "none" and stops:
            yield "  reaction_index: 0x6007"
            yield "  reaction_value: 3"
        yield f"  reaction: {'none' if kind == 'none' else 'quick_stop' if stops else 'coast'}"
        objects = {"heartbeat": "1016h:1", "node_guarding": "100Ch and 100Dh", "none": "no watchdog"}[kind]
        objects += ", 6007h" if stops else ""
        yield from self._entry(f"{self._file}, {objects}; what the drive then does isn't in it", "unverified")

    def _cyclic(self) -> Iterator[str]:
        period = self._writable(0x1006, "u32")
        yield "cyclic:"
        yield "  rate_hz: 250.0"
        yield f"  has_period: {'false' if period is None else 'true'}"
        yield from self._entry(f"{self._file} has {'no' if period is None else 'a'} 1006h; the rate is what ordinary "
                               "computers keep and a bus at 500 kbit/s carries", "verified")

    def _mapping_hints(self) -> None:
        """Add hints: can the objects of a run be mapped, and can the mapping be written?"""
        wanted = (*(_MUST_VL if _only_vl(self._eds) else _MUST), 0x6061)
        unmapped = [index for index in wanted if (one := self._eds.get(index)) is None or not one.mappable]
        if unmapped:
            listed = ", ".join(f"{index:04X}h" for index in unmapped)
            self._hints.append(f"The file doesn't allow {listed} in a PDO: preflight refuses such a drive")
        fixed = [index for index in (0x1600, 0x1A00) if (one := self._eds.get(index, 1)) is None or not one.writable]
        if fixed:
            listed = " and ".join(f"{index:04X}h" for index in fixed)
            self._hints.append(f"By the file the mapping in {listed} can't be written: look for free or dynamic PDO "
                               "mapping, and what must be set for it")

    def _writable(self, index: int, kind: str) -> EdsObject | None:
        """Return the object if the drive has it, with that type, and it can be written; else None."""
        one = self._eds.get(index)
        return one if one is not None and one.type == kind and one.writable else None


def _comment(text: str) -> list[str]:
    """Return a paragraph as comment lines within the page's width."""
    return [f"# {line}" for line in textwrap.wrap(text, 116, break_long_words=True, break_on_hyphens=False)]


def _plain(text: str) -> str:
    """Return a name from the file as one short printable line."""
    clean = "".join(sign if sign.isprintable() else " " for sign in text)
    return " ".join(clean.split())[:60].strip()


def _quoted(text: str) -> str:
    """Return a quoted YAML scalar; quotes and backslashes are escaped."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _slug(text: str) -> str:
    """Return the text reduced to the characters that a profile's name may have."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower().encode("ascii", "ignore").decode()).strip("-")[:40].strip("-")
