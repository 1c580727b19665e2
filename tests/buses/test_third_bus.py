"""Additional bus: all its code is in this file, and one entry in each of two lists adds it.

No other file names it: command line, rig.yaml, run, log, scan, doctor and profile page use `BUSES`.
"""

from __future__ import annotations

import argparse
import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest
from pydantic import Field

import tdhil
from drivers.drive import RawFrame
from drivers.errors import CommunicationLost, DataFileError
from profiles.entry import DriveProfile, ProfileEntry
from profiles.library import SCHEMAS
from profiles.model import DataModel
from tdhil.buses import Bus, Connection, DoctorFinding, FoundDrive, Line, Opening, ProfileTable, ok
from tdhil.cli.main import build_parser, main
from tdhil.config.options import Setting
from tdhil.config.registry import BUSES, BusEntry
from tdhil.config.rig import Rig, load_rig
from tdhil.recording.log_reader import read_frames, read_run
from tests.runner.line_drive import Line as SlowLine
from tests.runner.line_drive import LineDrive

ROOT = Path(__file__).parents[2]


class Stated(ProfileEntry):
    """Section of the profile of the toy bus."""

    ends: Literal["off", "held"] = "held"
    kind: str = "lease"
    reaction: str = "quick_stop"
    decelerates_in_torque_mode: bool = True


class ToyProfile(DriveProfile):
    """Profile of a drive on the toy bus."""

    bus: Literal["toy"]
    quick_stop: Stated
    watchdog: Stated
    parameters: tuple[Any, ...] = ()
    filters: tuple[Any, ...] = ()

    def entries(self) -> tuple[tuple[str, ProfileEntry], ...]:
        return (("quick_stop", self.quick_stop), ("watchdog", self.watchdog))

    @property
    def can_torque(self) -> bool:
        return True

    @property
    def usual_rate_hz(self) -> float:
        return 20.0

    @property
    def rated_torque_by_hand(self) -> bool:
        return False


class ToySection(DataModel):
    """Section toy: of rig.yaml."""

    peg: int | None = Field(default=None, ge=1, le=99, description="where it hangs")


OPENED: list[LineDrive] = []
CLOSED: list[LineDrive] = []


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--peg", type=int)


def _line(cli: Mapping[str, Any], rig: Rig | None, profile: Any) -> Line:
    if cli.get("peg") is not None:
        return Line({"peg": Setting.by_flag(cli["peg"], "--peg")})
    peg = None if rig is None else TOY_BUS.section_of(rig).peg
    return Line() if rig is None or peg is None else Line({"peg": Setting.by_rig(peg, rig, "toy.peg")})


@contextmanager
def _open(asked: Opening) -> Iterator[Any]:
    """Open the drive of `tests.runner.line_drive`, which no bus of tdhil has."""
    drive = LineDrive(SlowLine(0.1), seed=asked.plan.seed or 0, clock=asked.clock)
    OPENED.append(drive)
    asked.tap(RawFrame(0.0, True, 3, b"hello"))
    yield drive
    CLOSED.append(drive)


@contextmanager
def _open_target(options: Any, connection: Connection, clock: Any) -> Iterator[Any]:
    raise CommunicationLost("nobody there", where=f"peg {connection.line.value('peg')}")
    yield


def _parse_faults(texts: Sequence[str]) -> tuple[Any, ...]:
    return tuple(SimpleNamespace(text=text) for text in texts)


class Peg:
    """Option value of the toy bus."""

    def cells(self) -> tuple[str, str, str, str]:
        return "peg 7", "1", "1 toy", "what it is"

    def plain(self) -> dict[str, Any]:
        return {"peg": 7}


def _scan(plan: Any, connection: Connection, options: Any, asked: Any) -> tuple[tuple[FoundDrive, ...], list[str]]:
    return (FoundDrive("toy", connection.line.value("peg"), "a toy", "wood", plan.embedded),), ["it is asleep"]


def _findings(plan: Any, connection: Connection, options: Any, rig: Any, seen: list[Any]) -> Iterator[DoctorFinding]:
    yield ok("toy", f"peg {connection.line.value('peg')} answers")
    seen.append(Peg())


TOY_BUS = Bus(
    name="toy",
    title="Toy",
    named_by="--peg",
    examples=("--peg 7",),
    nothing_there="no peg is named",
    simulated_text="toy on a string",
    address_word="peg",
    address_flag="--peg",
    to_fill_in="a peg",
    flags={"peg": "--peg"},
    common_flags=frozenset({"--peg"}),
    place=("peg",),
    default_profile="toy.yaml",
    add_arguments=_add_arguments,
    line=_line,
    section="toy",
    section_model=ToySection,
    place_keys="peg",
    rig_section=lambda found, connection: {"peg": found.address},
    rig_keys=lambda found: {"rate_hz": 20.0},
    rig_blank=lambda profile: ("#toy: {peg: 7}",),
    open=_open,
    open_target=_open_target,
    parse_faults=_parse_faults,
    faults=lambda: (),
    fault_listing=lambda width: "bite: the toy bites",
    scan=_scan,
    wanted=lambda connection, options: None,
    findings=_findings,
    libraries={"pytest": (1,)},
    variables=("TOY_PEG",),
    profile_facts=lambda profile: (("wood", "oak"),),
    profile_tables=lambda profile: (ProfileTable("parts", ("part", "of"), (("wheel", "beech"),), ("glued",)),),
)


@pytest.fixture
def toy_bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bus:
    """Add the bus to both lists, and write one of its profiles to a folder."""
    monkeypatch.setitem(SCHEMAS, "toy", ToyProfile)
    monkeypatch.setitem(BUSES, "toy", BusEntry(f"{__name__}:TOY_BUS", "a toy"))
    monkeypatch.chdir(tmp_path)
    sure = "{source: carved by hand, confidence: verified}"
    (tmp_path / "toy.yaml").write_text(
        f"name: wood/toy\ntitle: A toy of wood\nbus: toy\nquick_stop: {sure}\nwatchdog: {sure}\n"
    )
    OPENED.clear()
    CLOSED.clear()
    return TOY_BUS


@pytest.mark.heavy
def test_a_run_on_a_toy_bus_is_complete(toy_bus, capsys):
    code = main(["identify", "--drive", "toy", "--simulate", "--seed", "3", "--json", "--model", "rigid",
                 "--excitation", "multisine", "--periods", "3"])
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert (code, document.get("verdict")) == (0, "valid"), err
    estimate = document["inertia_kg_m2"]
    assert estimate["low_total"] < 104.0 < estimate["high_total"]
    assert "embedded toy on a string" in err
    (drive,) = OPENED
    assert drive.cycles > 500 and [drive] == CLOSED
    logged = read_run(Path("run.mcap")).configuration
    assert (logged["drive"], logged["profile"]["name"]) == ("toy", "wood/toy")
    assert [frame.data for frame in read_frames(Path("run.mcap"))] == [b"hello"]
    assert main(["export", "run.mcap", "--to", "candump"]) == 2           # the frames of the toy bus are no CAN frames
    assert "contains no CAN frames" in capsys.readouterr().err


def test_scan_and_doctor_use_the_toy_bus(toy_bus, capsys):
    assert main(["scan", "--peg", "7", "--write", "rig.yaml"]) == 0
    assert "peg 7: a toy" in capsys.readouterr().out
    rig = load_rig(Path("rig.yaml"))
    assert (rig.drive, rig.rate_hz, toy_bus.section_of(rig).peg) == ("toy", 20.0, 7)
    main(["doctor", "--peg", "7", "--profile", "toy.yaml", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert {"grade": "ok", "name": "toy", "said": "peg 7 answers", "do": ""} in document["checks"]
    assert document["registers"] == [{"peg": 7}]
    main(["doctor", "--peg", "7"])
    assert "peg 7" in capsys.readouterr().out
    assert main(["profiles", "show", "toy.yaml"]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("A toy of wood", "wood          oak", "wheel", "beech", "glued"))
    assert main(["rig", "new", "new.yaml", "--profile", "toy.yaml", "--load", "none"]) == 0
    assert "the drive's address: a peg" in capsys.readouterr().err
    assert "#toy: {peg: 7}" in Path("new.yaml").read_text()


def test_rig_yaml_accepts_the_section_of_the_toy_bus(toy_bus, capsys):
    Path("rig.yaml").write_text("toy: {peg: 7}\n")
    assert toy_bus.section_of(load_rig(Path("rig.yaml"))).peg == 7
    assert main(["stop", "--rig", "rig.yaml"]) == 8                 # the bus follows from the section
    assert "peg 7: nobody there" in capsys.readouterr().err
    for text, said in (("toy: {peg: 700}\n", "rig.yaml:1: toy.peg: must be at most 99, not 700"),
                       ("toy:\n  pig: 7\n", "rig.yaml:2: toy: unknown key 'pig'; did you mean 'peg'?"),
                       ("drive: toi\n", f"{', '.join(map(repr, [*BUSES][:-1]))} or 'toy'")):
        Path("rig.yaml").write_text(text)
        with pytest.raises(DataFileError) as caught:
            load_rig(Path("rig.yaml"))
        assert said in str(caught.value)
    assert main(["scan"]) == 2
    assert "or --peg 7" in capsys.readouterr().err


def test_python_opens_the_toy_bus(toy_bus):
    with tdhil.simulate(drive="toy", seed=3) as drive:
        assert drive is not None


def test_the_command_line_distinguishes_the_toy_bus_from_the_others(toy_bus, capsys):
    assert build_parser("identify").parse_args(["identify", "--drive", "toy"]).drive == "toy"
    assert main(["stop", "--peg", "7"]) == 8
    assert "peg 7: nobody there" in capsys.readouterr().err
    for arguments, said in (
        (["--drive", "toy", "--host", "a"], "belongs to Modbus, but the drive is on Toy. Name a Toy drive with --peg"),
        (["--drive", "modbus", "--peg", "7"], "--peg: belongs to Toy, but"),
        (["--drive", "toy", "--profile", "generic/modbus"], "is a profile for modbus, and --drive says toy"),
        (["--peg", "7", "--stepped"], "a Toy line has no SYNC, so it can't be stepped"),
    ):
        assert main(["identify", *arguments]) == 2
        assert said in " ".join(capsys.readouterr().err.split())
    Path("wired.yaml").write_text("drive: toy\nbus: {interface: socketcan, channel: can0}\n")
    assert main(["identify", "--rig", "wired.yaml"]) == 2
    assert "wired.yaml:2: bus: gives a drive's address, but the drive is on toy" in capsys.readouterr().err
    assert main(["identify", "--fault", "list"]) == 0
    assert "--drive toy\n\nbite: the toy bites" in capsys.readouterr().out


@pytest.mark.heavy
def test_nothing_is_compared_with_the_name_of_a_bus():
    found = []
    for path in sorted((*(ROOT / "tdhil").rglob("*.py"), *(ROOT / "profiles").rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare | ast.MatchValue | ast.MatchOr):
                told = {one.value for one in ast.walk(node) if isinstance(one, ast.Constant)} & set(BUSES)
                found += [f"{path.relative_to(ROOT)}:{node.lineno}: {name}" for name in told]
    assert found == []
