"""Table in the documentation: it has all fifty rows and those beyond, and every test that it names exists."""

import re
from pathlib import Path

import pytest

from tests.faults.rows import FIFTY, ROWS
from tests.faults.test_ethercat_scripted import CASES as ETHERCAT
from tests.faults.test_rows_scripted import CASES as CANOPEN

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
    """Each fault name of the simulator occurs in a test of this room."""
    from sim_bus.canopen.faults import KINDS

    source = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    assert [name for name in KINDS if f'"{name}' not in source] == []


def test_the_page_states_each_fault_and_its_reaction_as_the_table(text):
    cells = {int(found[1]): found[0].split(" | ") for found in re.finditer(r"\| (\d+) \| .*", text)}
    assert {number: row[1:3] for number, row in cells.items()} == {
        number: [row.fault, row.expected] for number, row in ROWS.items()}


QUOTED = (*CANOPEN, *(case for case in ETHERCAT if ROWS[case.row].fault.startswith("EtherCAT")))


@pytest.mark.parametrize("case", QUOTED, ids=lambda case: case.id)
def test_a_quotation_has_the_words_that_its_case_requires(case, text):
    """A changed message needs a changed quotation. For a row of all buses, the page quotes CANopen."""
    row = re.search(rf"^\| {case.row} \| .*$", text, re.MULTILINE)
    assert row is not None
    quoted = [one for one in re.split(r"<br>| \| ", row[0]) if one.startswith(f"`{case.fault}`: ")]
    assert quoted
    assert [word for one in quoted for word in case.words if word not in one] == []
