import pytest


@pytest.fixture
def seen(request):
    """Record the result of a row for `benchmarks/fault_table.py`: ``seen(row, said, standstill_s, log)``."""
    from tests.faults.seen import Seen

    return Seen(request.node.nodeid)


@pytest.fixture
def rehearse(no_bus_of_the_user, tmp_path):
    """Run `tdhil identify --simulate` in this process: ``rehearse(*arguments)``, see `rehearsal`."""
    from tests.faults.rehearsal import run

    return lambda *arguments: run(tmp_path, *arguments)
