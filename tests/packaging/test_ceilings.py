"""Each room has a ceiling of source lines. It grows beyond the ceiling only with a decision record."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FIRST = "0078"
"""Decision record that set the ceilings."""
# Room: its ceiling in source lines, and the decision record that set or raised it.
CEILINGS = {
    "tdhil": (1_300, FIRST),
    "tdhil/buses": (3_000, FIRST),
    "tdhil/calibration": (1_500, FIRST),
    "tdhil/cli": (6_700, "0095"),
    "tdhil/config": (1_800, FIRST),
    "tdhil/estimation": (15_300, "0096"),
    "tdhil/evidence": (1_400, FIRST),
    "tdhil/fleet": (2_200, "0089"),
    "tdhil/recording": (5_400, FIRST),
    "tdhil/report": (7_150, "0097"),
    "tdhil/runner": (12_150, "0098"),
    "tdhil/service": (12_200, "0093"),
    "tdhil/session": (4_500, FIRST),
    "tdhil/soft_torque": (6_300, "0097"),
    "tdhil/speed_loop": (1_610, "0095"),
    "tdhil/studies": (6_100, FIRST),
    "drivers": (13_300, "0089"),
    "sim_bus": (12_000, FIRST),
    "profiles": (4_620, "0095"),
}
RESERVE = 0.25
"""Share by which a ceiling may exceed the lines. A higher ceiling has no effect and must be lowered."""
IN_ANOTHER = {"tdhil": "*.py"}
"""Rooms whose folder contains other rooms; only the files beside these count."""


def lines_of(room: str) -> int:
    """Return the source lines of a room, without those of the rooms below it."""
    paths = (ROOT / room).glob(IN_ANOTHER[room]) if room in IN_ANOTHER else (ROOT / room).rglob("*.py")
    return sum(path.read_text(encoding="utf-8").count("\n") for path in paths)


def test_every_room_has_a_ceiling():
    rooms = {f"tdhil/{path.parent.name}" for path in (ROOT / "tdhil").glob("*/__init__.py")}
    assert set(CEILINGS) == rooms | {"tdhil", "drivers", "sim_bus", "profiles"}


@pytest.mark.parametrize("room", CEILINGS)
def test_a_room_stays_below_its_ceiling(room):
    ceiling, decision = CEILINGS[room]
    lines = lines_of(room)
    assert lines <= ceiling, f"{room} has {lines} lines, and decision {decision} permits {ceiling}"
    assert lines >= (1.0 - RESERVE) * ceiling, f"{room} has {lines} lines: lower its ceiling of {ceiling}"


@pytest.mark.parametrize("room", CEILINGS)
def test_the_decision_that_set_a_ceiling_names_it(room):
    ceiling, decision = CEILINGS[room]
    (record,) = (ROOT / "docs" / "decisions").glob(f"{decision}-*.md")
    assert f"| {room} | {ceiling:,} |" in record.read_text(encoding="utf-8")
