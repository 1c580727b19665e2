"""Scrubbing of a run's log for others to read: what identification needs stays, every other entry is left out.

The entries of the configuration are chosen by an allowlist. A new entry of the log is therefore private until it is
listed here. Texts that stay lose names, addresses and paths. A name that the log states in a private entry is also
removed from every other text. Scrubbing a scrubbed log changes nothing, and the check of an archive relies on this.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from typing import Any, Final

from tdhil.config import BUSES, STATED
from tdhil.evidence.leaks import without_leaks

NAME: Final = "<name>"
GONE_SERIAL: Final = "<serial>"
"""Text in place of a serial number that is no number."""

_ENTRIES: Final = frozenset({
    "acceptance", "bench", "bus", "converted", "counters", "cycle", "drive", "embedded_simulator", "ended",
    "evaluation", "faults", "identify", "identity", "options", "plan", "plant", "profile", "rate_tried", "rehearsal",
    "reference_inertia_kg_m2", "seed", "speed_unit", "started", "stepped", "stop", "stopping", "tdhil",
    "torque_calibration", "unverified", "verification", "watchdog",
})
"""Entries of the log's configuration that stay."""
_OF_THE_BENCH: Final = frozenset({
    "accept_unverified", "acceptance", "allow_reverse", "drive", "drive_data", "expected", "gear", "limits", "load",
    "make_up_torque_nm", "node", "profile", "rate_hz", "reference_inertia_kg_m2", "torque_ramp_nm_s",
})
"""Entries of rig.yaml that stay. Address, name and folders are not among them."""
_PRIVATE: Final = frozenset({*STATED, "uploaded", "connection"})
"""Keys of the result document whose values are left out."""
_CATEGORICAL: Final = frozenset({"interface", "parity"})
"""Settings of the bus that stay although they are texts."""
_ADDRESSES: Final = frozenset({"host", "channel", "serial", "interface", "alias", "url"})
"""Keys of a bus whose texts are addresses."""
_KEY: Final = re.compile(r"[A-Za-z0-9_.:+%-]{1,60}")
_WORD: Final = re.compile(r"[^\W_]+(?:[-'][^\W_]+)*")
_SHORTEST: Final = 3
"""Shortest word of a name that is removed, characters."""
_SHORTEST_NUMBER: Final = 4
"""Shortest serial number that is removed from a text, digits. A shorter one occurs as another number."""
_SERIAL_OBJECT: Final = b"\x18\x10\x04"
"""Index 1018h, sub-index 4 (serial number) as SDO transfers have it (CiA 301, 7.2.4)."""
_LSS: Final = (0x7E4, 0x7E5)
"""Identifiers of the layer setting services: of the slave and of the master (CiA 305). Only CAN frames have such
identifiers: those of Modbus are unit numbers, those of EtherCAT sync managers."""
_LSS_SERIAL: Final = frozenset({0x43, 0x4A, 0x4B, 0x5D})
"""Commands of LSS with a serial number behind them: switch selective, lowest and highest of a search, inquiry."""
_LSS_FASTSCAN, _SCANNED_SERIAL = 0x51, 3
"""Fastscan searches a number of 1018h bit by bit; that of the serial number."""


class LogScrub:
    """The scrubbing of one log. ``run``: its configuration; ``words``: further words to remove.

    ``rig_name``: whether the name of the rig stays. Serial numbers become 1, 2, … in the order of their appearance, so
    equal drives stay equal and different ones stay different.
    """

    def __init__(self, run: Mapping[str, Any], words: Iterable[str] = (), *, rig_name: bool = False) -> None:
        self._rig_name = rig_name
        self._serials: dict[int, int] = {}
        bench = _part(run.get("bench"))
        self._kept_name = str(bench.get("name") or "") if rig_name else ""
        self._serial(_part(run.get("identity")).get("serial"))
        found = {*words, *_names_in(run, rig_name=rig_name)}
        found |= {form for number in self._serials for form in (
            str(number), *(f"{sign}{number:{form}}{unit}" for form in ("x", "08x")
                           for sign, unit in (("", ""), ("", "h"), ("0x", ""))))
                  if len(form) >= _SHORTEST_NUMBER}
        found = {word for word in found if len(word) >= _SHORTEST}
        self.words = tuple(sorted(found, key=lambda word: (-len(word), word)))
        """Words that are removed, the longest first."""
        either = "|".join(map(re.escape, self.words))
        self._names = re.compile(rf"(?<![^\W_])(?:{either})(?![^\W_])", re.IGNORECASE) if either else None

    def text(self, text: str) -> str:
        """Scrub one text."""
        text = without_leaks(text)             # whole paths first, or the names in them would cut them
        return text if self._names is None else without_leaks(self._names.sub(NAME, text))

    def value(self, value: Any, key: str = "") -> Any:
        """Scrub plain data at all levels; numbers and keys that are plain names stay."""
        if key == "serial":
            return self._serial(value)
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, Mapping):
            return {self._name(str(name)): self.value(one, str(name)) for name, one in value.items()}
        if isinstance(value, list | tuple):
            return [self.value(one) for one in value]
        return value

    def configuration(self, run: Mapping[str, Any]) -> dict[str, Any]:
        """Return the run's configuration with the entries that stay, scrubbed."""
        kept = {name: value for name, value in run.items() if name in _ENTRIES}
        for name, change in _CHANGES.items():
            if name in kept:
                kept[name] = change(kept[name])
        found: dict[str, Any] = self.value(kept)
        if self._kept_name and isinstance(found.get("bench"), dict):
            found["bench"]["name"] = self._kept_name
        return found

    def result(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Return a result document without names, notes, addresses and folders."""
        kept: dict[str, Any] = {name: None if name in _PRIVATE else value for name, value in document.items()}
        if "log" in kept:
            kept["log"] = "run.mcap"
        if isinstance(kept.get("date"), str):
            kept["date"] = _utc(kept["date"])
        rig = kept.get("rig")
        if isinstance(rig, Mapping):
            kept["rig"] = {**rig, "name": None, "file": None}
        found: dict[str, Any] = self.value(kept)
        if self._kept_name and isinstance(found.get("rig"), dict):
            found["rig"]["name"] = self._kept_name
        return found

    def message(self, channel: int, payload: bytes) -> bytes:
        """Scrub one message of the log. Fields that tdhil does not know are left out of it."""
        from tdhil.recording import CHANNELS, CLASSES, RAW_FRAMES

        name = CHANNELS[channel][1]
        message = CLASSES[name].FromString(payload)
        message.DiscardUnknownFields()
        if channel in RAW_FRAMES:
            for frame in message.frames:
                frame.data = self.frame(frame.data, frame.identifier)
        elif name == "Text":
            message.json = self._json(CHANNELS[channel][0], message.json)
        else:
            self._texts_of(message)
            if name == "Event":
                message.traceback = ""         # it names folders of the computer
        scrubbed: bytes = message.SerializeToString(deterministic=True)
        return scrubbed

    def frame(self, data: bytes, identifier: int) -> bytes:
        """Replace the serial number in a frame that carries object 1018h:4, or names it by LSS (CiA 305)."""
        at = data.find(_SERIAL_OBJECT)
        start = at + len(_SERIAL_OBJECT)
        if identifier in _LSS and len(data) >= 5:
            if data[0] == _LSS_FASTSCAN and (len(data) < 7 or data[6] == _SCANNED_SERIAL):
                return data[:1] + bytes(4) + data[5:]        # a part of the number, which is no number of a drive
            at, start = (0, 1) if data[0] in _LSS_SERIAL else (-1, 0)
        if at < 0 or len(data) < start + 4:
            return data
        number = self._serial(int.from_bytes(data[start:start + 4], "little"))
        return data[:start] + int(number).to_bytes(4, "little") + data[start + 4:]

    # ----------------------------------------------------------------------------------------------------------------

    def _serial(self, value: Any) -> Any:
        if not isinstance(value, int) or isinstance(value, bool) or value == 0:
            return value if value in (None, 0) else GONE_SERIAL
        return self._serials.setdefault(value, len(self._serials) + 1)

    def _name(self, key: str) -> str:
        """Return a key; keys of the log's own are plain names, and any other one is a text."""
        plain = _KEY.fullmatch(key) is not None
        return key if plain and (self._names is None or not self._names.search(key)) else self.text(key)

    def _json(self, topic: str, text: str) -> str:
        try:
            content = json.loads(text)
        except ValueError:
            return "{}"
        if not isinstance(content, dict):
            return "{}"
        if topic == "/result":
            content = self.result(content)
        else:
            content = {name: self.configuration(part) if name == "run" else self.value(part)
                       for name, part in content.items()
                       if name in ("run", "recording") and isinstance(part, dict)}
        return json.dumps(content, ensure_ascii=False)

    def _texts_of(self, message: Any) -> None:
        for field, value in message.ListFields():
            repeated = hasattr(value, "append") or hasattr(value, "add")
            if field.message_type is not None:
                for one in value if repeated else (value,):
                    self._texts_of(one)
            elif field.type == field.TYPE_STRING:
                if repeated:
                    value[:] = [self.text(one) for one in value]
                else:
                    setattr(message, field.name, self.text(value))


def _names_in(run: Mapping[str, Any], *, rig_name: bool) -> set[str]:
    """Return the names that the private entries of a configuration state: of persons, rigs, hosts, folders."""
    bench = _part(run.get("bench"))
    found: set[str] = set()
    texts = [run.get(name) for name in STATED if name != "note"] + ([] if rig_name else [bench.get("name")])
    for text in texts:
        if isinstance(text, str):
            found |= {text.strip(), *_WORD.findall(text)}
    for name, row in _part(run.get("bus")).items():
        value = _part(row).get("value")
        if name in _ADDRESSES - _CATEGORICAL and isinstance(value, str) and not value.startswith(("can", "vcan")):
            found |= {value, value.partition(".")[0]}
    for part in ("bus", *BUSES):
        for name, value in _part(bench.get(part)).items():
            if name in _ADDRESSES and name != "interface" and isinstance(value, str):
                found |= {value, value.partition(".")[0]}
    options = _part(run.get("options"))
    files = [run.get("rig_file"), *(_part(row).get("value") for row in options.values())]
    for file in files:
        if isinstance(file, str) and re.search(r"[/\\]", file):
            found |= {part for part in re.split(r"[/\\]", file)[:-1] if part not in _COMMON_FOLDERS}
    rig_file = run.get("rig_file")
    if isinstance(rig_file, str):
        stem = re.split(r"[/\\]", rig_file)[-1].rpartition(".")[0]
        found |= {stem} - _COMMON_FOLDERS
    return {word for word in found if word and not word.isdigit() and word.lower() not in _COMMON_FOLDERS}


_COMMON_FOLDERS: Final = frozenset({
    "", ".", "..", "~", "bench", "c:", "data", "desktop", "documents", "downloads", "drive", "etc", "examples",
    "generic", "home", "log", "logs", "media", "mnt", "opt", "profile", "profiles", "rig", "rigs", "root", "run",
    "runs", "srv", "tdhil", "tmp", "torque", "speed", "users", "usr", "var", "work",
})
"""Names of folders and files that identify nothing, and that occur as words."""


def _part(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _bench(bench: Any) -> dict[str, Any]:
    kept = {name: value for name, value in _part(bench).items() if name in _OF_THE_BENCH}
    data = _part(kept.get("drive_data"))
    if data.get("torque_calibration"):
        kept["drive_data"] = {**data, "torque_calibration": "calibration.json"}
    return kept


def _bus(bus: Any) -> dict[str, Any]:
    """Keep settings of the line that are numbers, and the kind of interface. An address is left out."""
    kept = {}
    for name, row in _part(bus).items():
        value = _part(row).get("value")
        number = isinstance(value, int | float) or (
            isinstance(value, str) and re.fullmatch(r"-|[0-9]{1,9}(\.[0-9]+)?", value) is not None)
        if name not in _ADDRESSES - _CATEGORICAL and (number or name in _CATEGORICAL):
            kept[name] = {"value": value, "source": "-"}
    return kept


def _options(options: Any) -> dict[str, Any]:
    """Keep the options of the run that are no file and no free text, without the lines of rig.yaml."""
    from tdhil.config import OPTION

    kept = {}
    for name, row in _part(options).items():
        option = OPTION.get(str(name))
        source = str(_part(row).get("source", ""))
        if option is not None and not (option.is_file or option.free_text):
            kept[name] = {"value": _part(row).get("value"),
                          "source": source if source.startswith("--") or source == "default" else "rig.yaml"}
    return kept


def _ended(ended: Any) -> Any:
    return {name: value for name, value in _part(ended).items() if name != "where"} if ended else ended


def _converted(rows: Any) -> list[Any]:
    """Keep key and values of each conversion, without the line of rig.yaml."""
    return [[*row[:2], "rig.yaml"] for row in rows if isinstance(row, list) and len(row) >= 2] if rows else []


def _calibration(document: Any) -> Any:
    """Leave the folders of the calibration's logs out; their hashes stay."""
    runs = _part(document).get("runs")
    if not isinstance(runs, list):
        return document
    return {**document, "runs": [{**one, "log": "run.mcap"} if isinstance(one, dict) and "log" in one else one
                                 for one in runs]}


def _utc(text: Any) -> Any:
    """Return a time in UTC: the offset of local time names a region."""
    try:
        return datetime.fromisoformat(str(text)).astimezone(UTC).isoformat(timespec="seconds")
    except ValueError:
        return None


_CHANGES: Final[Mapping[str, Callable[[Any], Any]]] = {
    "bench": _bench, "bus": _bus, "converted": _converted, "ended": _ended, "options": _options, "started": _utc,
    "torque_calibration": _calibration,
}
"""Entries that stay in a part."""
