"""One setting for every property test: the same examples at every run. TDHIL_FUZZ=1 looks for new ones instead.

The longest cases run with --long only, which the header of every run says.

And Ctrl-C as usual: a shell that starts the tests in the background has it ignored, which every child would inherit.
"""

import os
import re
import signal
import threading

import pytest
from hypothesis import settings

settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("fuzz", deadline=None, max_examples=1000)
settings.load_profile("fuzz" if os.environ.get("TDHIL_FUZZ") else "same")

if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

LONG = re.compile(
    r"test_modbus_profiles\.py::.*\[(?!generic/modbus|siemens/g120\]|schneider/atv320|siemens/s120)"
    r"|test_modbus_wrongs\.py::.*\[(?!generic|abb/acs880-classic)"
    r"|test_stops\.py::test_a_signal_in_each_stage\[(SIGTERM|SIGINT twice)-(setup|torque|hold)"
    r"|test_stops\.py::test_an_exception_in_each_stage\[(torque|hold)"
    r"|test_modbus_scripted\.py::test_row\["
    r"|test_rows_scripted\.py::test_the_other_stages"
)
"""More cases of what others show already, and minutes of it: with --long."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the cases that are left out for their time")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--long"):
        return
    left_out = [item for item in items if LONG.search(item.nodeid)]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not LONG.search(item.nodeid)]


def pytest_report_header(config: pytest.Config) -> str:
    done = "run too" if config.getoption("--long") else "LEFT OUT, see LONG in tests/conftest.py (--long)"
    return f"long cases: {done}"
