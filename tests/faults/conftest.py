import sys
from pathlib import Path

import pytest

# For helpers of this room and of others: tests are imported by path, not as a package.
for room in ("protocol", "path", "faults"):
    sys.path.insert(0, str(Path(__file__).parents[1] / room))


@pytest.fixture
def seen(request):
    """Keeps what a test saw of a row, for `benchmarks/fault_table.py`: ``seen(row, said, standstill_s, log)``."""
    from seen import Seen

    return Seen(request.node.nodeid)


@pytest.fixture
def no_bus_of_the_user(monkeypatch, tmp_path):
    """Neither the environment nor the files of whoever runs the tests name a bus here."""
    import os

    for name in list(os.environ):
        if name.startswith("CAN_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def rehearse(no_bus_of_the_user, tmp_path):
    """`tdhil identify --simulate` in this process: ``rehearse(*arguments)``, see `rehearsal`."""
    from rehearsal import run

    return lambda *arguments: run(tmp_path, *arguments)
