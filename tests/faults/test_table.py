"""The table in the documentation: all fifty rows and those beyond, and every test that it names exists."""

import re
from pathlib import Path

import pytest

from tests.faults.rows import FIFTY, ROWS

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "docs" / "reference" / "faults.md"


@pytest.fixture(scope="module")
def text():
    return TABLE.read_text(encoding="utf-8")


def test_all_rows_are_there(text):
    rows = [line.split(" | ") for line in text.splitlines() if re.match(r"\| \d", line)]
    assert [int(row[0].strip("| ")) for row in rows] == list(ROWS) == list(range(1, len(ROWS) + 1))
    assert len(FIFTY) == 50
    assert all(len(row) == 7 and row[3].strip() for row in rows)


def test_every_named_test_exists(text):
    named = set(re.findall(r"`(tests/[\w/.]+::\w+)`", text)) | {test for row in ROWS.values() for test in row.tests}
    assert len(named) > 60
    for name in named:
        file, function = name.split("::")
        assert f"def {function}(" in (ROOT / file).read_text(encoding="utf-8"), name


def test_every_scripted_fault_is_rehearsed():
    """Each name that the simulator knows stands in one of this room's tests."""
    from sim_bus.canopen.faults import KINDS

    source = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    assert [name for name in KINDS if f'"{name}' not in source] == []
