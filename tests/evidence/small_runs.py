"""Small logs with every possible entry, made in milliseconds, with a simulated result of the identification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drivers.drive import Command, Mode, PowerState, RawFrame, Sample
from tdhil.recording.log_format import Event
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Stage
from tdhil.version import __version__

SERIAL = 1_234_567_890
RESULT = {
    "verdict": "valid", "simulated": False, "log": "run.mcap", "tdhil": __version__, "operator": None, "note": None,
    "inertia_kg_m2": {"value": 104.0, "low_total": 100.0, "high_total": 108.0, "low": 103.0, "high": 105.0,
                      "confidence": 0.95},
}
PROFILE = {
    "name": "maxon/epos4", "title": "A drive", "bus": "canopen",
    **{name: {"source": "the manual", "confidence": "likely", "value": number}
       for number, name in enumerate(("identity", "modes", "quick_stop", "speed", "torque", "watchdog"))},
}
LSS = ((0x7E4, 0x5D, bytes(3)), (0x7E5, 0x43, bytes(3)), (0x7E5, 0x4A, bytes(3)), (0x7E5, 0x51, b"\x08\x03\x00"))
"""Frames of LSS with a serial number: identifier, command, and the bytes after the number (CiA 305)."""
STAGES = ("setup", "speed", "torque", "hold", "acquire")


def found(log: Path) -> dict[str, Any]:
    """Return the result of a replay, without a replay."""
    return dict(RESULT)


def configuration(**more: Any) -> dict[str, Any]:
    return {
        "tdhil": __version__, "started": "2026-03-01T12:00:00+02:00", "drive": "canopen", "faults": [],
        "identity": {"vendor": 0xFB, "product": 7, "revision": 0x10000, "serial": SERIAL, "name": "EPOS4",
                     "simulated": False},
        "profile": PROFILE, "identify": {"model": "auto", "confidence": 0.95, "tolerance": 0.05},
        "speed_unit": {"seen_by": "position", "ratio": 1.0, "where": "6064h"},
        "stop": {"confirmed": True, "at_rest_s": 3.0}, "bench": {"name": None, "limits": {"torque_nm": 400.0}},
        **more,
    }


def write_run(path: Path, run: dict[str, Any] | None = None, *, simulated: bool = False,
              events: tuple[Event, ...] = (), result: dict[str, Any] | None = None, serial: int = SERIAL,
              stages: tuple[str, ...] = STAGES) -> Path:
    """Write a complete log of a run with 40 samples. The drive reports its serial number in a frame."""
    with RunWriter(path, epoch_ns=1_772_000_000 * 10**9, block=True) as writer:
        writer.configuration(configuration() if run is None else run, {"gear_ratio": 2.0, "simulated": simulated})
        writer.frame(RawFrame(0.0, False, 0x581, b"\x43\x18\x10\x04" + serial.to_bytes(4, "little")))
        writer.frame(RawFrame(0.0, True, 0x601, b"\x40\x18\x10\x04\0\0\0\0"))
        for identifier, command, rest in LSS:
            writer.frame(RawFrame(0.0, False, identifier, bytes((command,)) + serial.to_bytes(4, "little") + rest))
        for text in ("identity: found vendor FBh (ok) 1018h", "watchdog: required 500 ms, found 500 ms (ok)"):
            writer.event(Event(0.0, "preflight", text))
        writer.event(Event(0.5, "mode", "torque mode confirmed, seeded with 80 N·m"))
        for one in events:
            writer.event(one)
        for cycle in range(40):
            time_s = 0.1 * cycle
            writer.command(time_s, Command(Mode.TORQUE, 1.0, 2.0))
            writer.sample(Sample(time_s, 0.0, 0.0, True, 3.0 + 0.1 * cycle, 100.0, None, Mode.TORQUE,
                                 PowerState.ENABLED, False, False, 7))
        for number, name in enumerate(stages):
            writer.stage(Stage(name, 0.8 * number, 0.8 * number + 0.7, "ok"))
        writer.result(RESULT if result is None else result)
    return path
