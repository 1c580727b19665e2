"""EDS and DCF files (CiA 306), read strictly: the content of the file, or every problem with its line.

The canopen library makes the object dictionary. It ignores values that it can't read, takes an indented line for the
end of the line before, and stops at the first error without a line number. So this module checks the text first, and
passes clean text to the library: keywords as CiA 306 spells them, parents before their subindices.
"""

import io
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from profiles.errors import DataFileError, Problem

MAX_BYTES = 8 * 1024 * 1024
MAX_PROBLEMS = 20
SUFFIXES = (".eds", ".dcf")

_OBJECT = re.compile(r"([0-9A-F]{4})(?:SUB([0-9A-F]{1,2}))?", re.IGNORECASE)
_KEYWORDS = {word.lower(): word for word in (
    "ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "ParameterValue", "LowLimit", "HighLimit",
    "PDOMapping", "CompactSubObj", "NrOfEntries", "VendorName", "VendorNumber", "ProductName", "ProductNumber",
    "RevisionNumber", "NodeID",
)}
_KEPT = {
    "DeviceInfo": ("VendorName", "VendorNumber", "ProductName", "ProductNumber", "RevisionNumber"),
    "DeviceComissioning": ("NodeID",),      # spelt this way by CiA 306
}
"""Sections beside the objects, and their keys, that canopen gets. Errors in other sections could stop canopen."""
_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_SECTIONS = {name.lower(): name for name in _KEPT}
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_DOMAIN, _VAR, _ARRAY, _RECORD = 2, 7, 8, 9
_KINDS = (0, _DOMAIN, 5, 6, _VAR, _ARRAY, _RECORD)
"""ObjectType of CiA 301. 0 (empty), 5 and 6 (type definitions) hold no values."""
_PLAIN = {3: "i16", 2: "i8", 4: "i32", 5: "u8", 6: "u16", 7: "u32", 8: "f32"}
_LAST_TYPE = 0x1B
_TEXT = (9, 10, 11, 15)
"""Data types of CiA 301 without a number as value: strings and domains."""


@dataclass(frozen=True)
class EdsObject:
    """One object, or one subindex of it, as in the file. ``line``: line of its section."""

    index: int
    sub: int
    type: str                          # u8, i16 … f32; "other" for any other type
    access: str
    mappable: bool
    line: int
    default: float | None = None       # DefaultValue
    value: float | None = None         # ParameterValue, in a DCF: the setting of this one drive
    low: float | None = None
    high: float | None = None

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access in ("wo", "rw", "rwr", "rww")

    @property
    def stands(self) -> float | None:
        """Value of the object: the setting in the DCF, else the default; None if the file has none."""
        return self.default if self.value is None else self.value

    def takes(self, number: float) -> bool:
        """Return whether the number is within the file's limits."""
        return (self.low is None or number >= self.low) and (self.high is None or number <= self.high)


@dataclass(frozen=True)
class EdsFile:
    """Content of an EDS or DCF, as far as a profile can use it. Texts are as in the file."""

    name: str                          # name of the file, without its folder
    vendor_name: str
    product_name: str
    vendor: int | None                 # DeviceInfo; None for 0
    product: int | None
    node: int | None                   # of a DCF; None in an EDS
    objects: MappingProxyType[tuple[int, int], EdsObject]

    def get(self, index: int, sub: int = 0) -> EdsObject | None:
        """Return the object; None if the file has none."""
        return self.objects.get((index, sub))


@dataclass
class _Section:
    line: int
    values: dict[str, str] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)


class _Reader:
    def __init__(self, path: Path) -> None:
        self._file = str(path)
        self._problems: list[Problem] = []
        self._sections: dict[str, _Section] = {}

    def refuse(self, line: int, message: str) -> None:
        self._problems.append(Problem(self._file, line, message))

    def check(self) -> None:
        """Raise DataFileError with the problems found so far."""
        if self._problems:
            found = sorted(dict.fromkeys(self._problems), key=lambda problem: problem.line)
            more = len(found) - MAX_PROBLEMS
            if more > 0:
                found[MAX_PROBLEMS:] = [Problem(self._file, 0, f"and {more} more problems")]
            raise DataFileError(tuple(found))

    def text(self, path: Path) -> str:
        if path.suffix.lower() not in SUFFIXES:
            self.refuse(0, "is neither .eds nor .dcf; XDD and EPF files are not read: ask the maker for the EDS")
        self.check()
        try:
            with path.open("rb") as stream:
                raw = stream.read(MAX_BYTES + 1)
        except FileNotFoundError:
            self.refuse(0, "no such file")
        except (OSError, ValueError) as error:
            self.refuse(0, f"can't be read ({error})")
        self.check()
        if len(raw) > MAX_BYTES:
            self.refuse(0, f"larger than {MAX_BYTES // 2**20} MiB: this is no EDS")
        elif b"\0" in raw:
            self.refuse(raw.count(b"\n", 0, raw.index(b"\0")) + 1, "holds zero bytes: this is no text file")
        self.check()
        try:
            return raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            return raw.decode("latin-1")       # encoding of most manufacturers' tools

    def split(self, text: str) -> None:
        """Split the text into sections and their keys."""
        section: _Section | None = None
        for number, raw in enumerate(re.split(r"\r\n|\r|\n", text), start=1):
            line = raw.strip()
            if not line or line[0] in ";#":
                continue
            if line[0] == "[":
                name, closed, _ = line[1:].partition("]")
                # in one spelling: 1016SUB1 and 1016Sub01 as 1016sub1, other names as in CiA 306
                if match := _OBJECT.fullmatch(name := name.strip()):
                    name = match[1].upper() + ("" if match[2] is None else f"sub{int(match[2], 16):X}")
                else:
                    name = _SECTIONS.get(name.lower(), name)
                if not closed or not name:
                    self.refuse(number, "a section's name stands between [ and ]")
                elif name in self._sections:
                    first = self._sections[name].line
                    self.refuse(number, f"section {_shown(name)} stands here a second time; first in line {first}")
                section = self._sections.setdefault(name, _Section(number))
                continue
            key, equals, value = line.partition("=")
            key = key.strip()
            if not equals or not key:
                self.refuse(number, "neither [section], key=value nor a comment (;)")
            elif section is None:
                self.refuse(number, "stands before the first [section]")
            else:
                key = _KEYWORDS.get(key.lower(), key)
                if key in section.values:
                    self.refuse(number, f"{_shown(key)} stands twice in its section")
                section.values[key] = re.split(r"\s;", f" {value}", maxsplit=1)[0].strip()
                section.lines[key] = number

    def number(self, section: _Section, key: str, low: int = 0, high: int = 0xFFFF_FFFF) -> int | None:
        """Return a number of the section; None, and a problem, if the text is not a number in the range."""
        text = section.values[key]
        try:
            found = int(text, 0)
        except ValueError:
            said = "is empty: must be a number" if not text else f"is {_shown(text)}: must be a number"
            self.refuse(section.lines[key], f"{key} {said}, such as 251 or 0xFB (0 where the maker doesn't tell it)")
            return None
        if not low <= found <= high:
            self.refuse(section.lines[key], f"{key} is {_shown(text)}: must be from {low} to {high}")
            return None
        return found

    def check_entries(self) -> None:
        """Check every key that canopen reads as a number or requires."""
        if "DeviceInfo" not in self._sections:
            self.refuse(0, "has no section [DeviceInfo]: this is no EDS, or only a part of one")
        for name, keys in _KEPT.items():
            section = self._sections.get(name, _Section(0))
            for key in keys:
                if key == "NodeID" and key in section.values:
                    self.number(section, key, 1, 127)
                elif key.endswith("Number") and key in section.values:
                    self.number(section, key)
        for name, section in self._sections.items():
            if match := _OBJECT.fullmatch(name):
                self._object(name, section, match)
            elif name.lower() in _LISTS:
                self._listed(section)
        self.check()

    def _listed(self, section: _Section) -> None:
        """Report an object that is listed but not described: it is unknown whether the drive has it."""
        for key, value in section.values.items():
            if key.isdigit() and re.fullmatch(r"0x[0-9A-Fa-f]{4}", value) and value[2:].upper() not in self._sections:
                self.refuse(section.lines[key], f"lists {value}, which no section [{value[2:]}] describes")

    def _object(self, name: str, section: _Section, match: re.Match[str]) -> None:
        if "ParameterName" not in section.values:
            self.refuse(section.line, f"object {name} has no ParameterName")
        kind = self.number(section, "ObjectType") if section.values.get("ObjectType") else _VAR
        if kind is not None and kind not in _KINDS:
            self.refuse(section.lines["ObjectType"], f"ObjectType is {kind}: 2, 5 to 9 are what there is")
        if section.values.get("PDOMapping") is not None:
            self.number(section, "PDOMapping", 0, 1)
        compact = section.values.get("CompactSubObj")
        if compact:
            self.number(section, "CompactSubObj", 0, 254)
        if match[2] is not None and match[1] not in self._sections:
            self.refuse(section.line, f"object {name} has no section [{match[1]}] that it belongs to")
        if kind in (_VAR, _DOMAIN) or match[2] is not None or compact:
            for key in ("DataType", "AccessType"):
                if not section.values.get(key):
                    self.refuse(section.lines.get(key, section.line), f"object {name} has no {key}")
            if section.values.get("DataType"):
                self.number(section, "DataType", 1, 0xFFFF)
            access = section.values.get("AccessType", "").lower()
            if access and access not in _ACCESS:
                self.refuse(section.lines["AccessType"],
                            f"AccessType is {_shown(access)}: {', '.join(_ACCESS)} are what there is")

    def values_of(self, name: str, data_type: int) -> dict[str, float]:
        """Return default, value and limits. Add a problem for each that isn't a number of its type."""
        section = self._sections.get(name)
        found: dict[str, float] = {}
        if section is None or data_type in _TEXT:
            return found
        for key, field_name in (("DefaultValue", "default"), ("ParameterValue", "value"), ("LowLimit", "low"),
                                ("HighLimit", "high")):
            text = section.values.get(key, "")
            if not text or "$NODEID" in text.upper():
                continue
            try:
                number = _number(text, data_type)
            except ValueError:
                self.refuse(section.lines[key], f"{key} of {name} is {_shown(text)}: must be a number of its type")
            else:
                found[field_name] = number
        return found

    def clean(self) -> str:
        """Return the file for canopen: each object before its subindices, and only the sections that a
        profile needs.
        """
        out = io.StringIO()
        for name in sorted(self._sections, key=_rank):
            section, parent = self._sections[name], self._sections.get(name[:4])
            kind = parent.values.get("ObjectType", "") if parent else ""
            # Object types 0, 5 and 6 only define a type.
            if _rank(name) < 4 and not (kind and int(kind, 0) in (0, 5, 6)):
                out.write(f"[{name}]\n")
                kept = _KEPT.get(name, section.values)
                values = section.values | ({} if name in _KEPT else {"ParameterName": name})
                out.writelines(_pair(key, values[key]) for key in kept if values.get(key))
        return out.getvalue()

    def section_of(self, index: int, sub: int, *, alone: bool) -> tuple[str, int]:
        """Return (section that describes the subindex, its line)."""
        names = (f"{index:04X}",) if alone or sub else ()
        names = names if alone else (f"{index:04X}sub{sub:X}", *names)
        name = next((name for name in names if name in self._sections), "")
        return name, self._sections[name].line if name else 0


def read_eds(path: Path) -> EdsFile:
    """Return the content of an EDS or DCF. Raises DataFileError with every problem and its line."""
    reader = _Reader(path)
    reader.split(reader.text(path))
    reader.check()
    reader.check_entries()
    try:
        from canopen.objectdictionary import ODVariable, eds

        dictionary = eds.import_eds(io.StringIO(reader.clean()), None)
    except Exception as error:      # any error of the library is an error of the file
        said = f"canopen can't read it ({type(error).__name__}: {_shown(str(error))})"
        raise DataFileError((Problem(str(path), 0, said),)) from error
    found: dict[tuple[int, int], EdsObject] = {}
    for entry in dictionary.values():
        alone = isinstance(entry, ODVariable)
        for one in [entry] if alone else list(entry.subindices.values()):
            name, line = reader.section_of(one.index, one.subindex, alone=alone)
            found[one.index, one.subindex] = EdsObject(
                one.index, one.subindex, _PLAIN.get(one.data_type, "other"), one.access_type, bool(one.pdo_mappable),
                line, **reader.values_of(name, one.data_type),
            )
    reader.check()
    info = dictionary.device_information
    return EdsFile(
        path.name, info.vendor_name or "", info.product_name or "", info.vendor_number or None,
        info.product_number or None, dictionary.node_id, MappingProxyType(found),
    )


def _pair(key: str, value: str) -> str:
    """Return the line of a key. A manufacturer's own data type becomes a domain, because canopen would look for its
    definition.
    """
    if key == "DataType" and int(value, 0) > _LAST_TYPE:
        value = "0x0F"
    return f"{key}={value}\n"


def _rank(name: str) -> int:
    """Return the rank of a section; 4 = not used."""
    if name in _KEPT:
        return 0
    if match := _OBJECT.fullmatch(name):
        return 1 if match[2] is None else 2
    return 3 if re.fullmatch(r"[0-9A-Fa-f]{4}Name", name) else 4


def _number(text: str, data_type: int) -> float:
    """Return the value of that type of CiA 301. A hexadecimal number of a signed type is a two's complement."""
    if data_type in (0x08, 0x11):
        number = float(text) if not text.lower().startswith("0x") else float(int(text, 16))
        if not math.isfinite(number):
            raise ValueError(text)
        return number
    whole = int(text.replace(" ", ""), 0)
    bits = {2: 8, 3: 16, 4: 32}.get(data_type)
    if bits is not None and whole >= 1 << bits - 1 and text.strip().lower().startswith("0x"):
        whole -= 1 << bits
    limit = bits if bits is not None else 64
    if not -(1 << limit) < whole < 1 << limit:
        raise ValueError(text)
    return whole


def _shown(text: str) -> str:
    """Return a text of the file for a message: printable signs, at most 40."""
    clean = "".join(sign if sign.isprintable() else "·" for sign in text)
    return f"'{clean[:40]}{'…' if len(clean) > 40 else ''}'"
