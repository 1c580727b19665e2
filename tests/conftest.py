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
    r"path/test_modbus_profiles\.py::.*\[(?!generic/modbus|siemens/g120\]|schneider/atv320|siemens/s120)"
    r"|path/test_modbus_wrongs\.py::(?!test_(a_real_drive|so_no_wrong)).*\[(?!generic|abb/acs880-classic)"
    r"|test_stops\.py::test_a_signal_in_each_stage\[(SIGTERM|SIGINT twice)-(setup|torque|hold)"
    r"|test_stops\.py::test_a_signal_in_each_stage\[(SIGTERM-acquire|SIGINT twice-speed)"
    r"|test_stops\.py::test_an_exception_in_each_stage\[(torque|hold)"
    r"|test_kill_at_random\.py::.*\[1\]"
    r"|test_real_peer\.py::test_a_wrong_word_moves_nothing\[MOVE it"
    r"|test_field_rig\.py::.*(_slopes\[0\.[35]-|_inertia\[[23]\]|_identified\[2\])"
    r"|test_modbus_scripted\.py::test_row\["
    r"|test_rows_scripted\.py::test_the_other_stages"
    r"|test_default_plan\.py::.*_filters\[(two poles|matched|two long poles|torque through two poles)"
    r"|test_hopeless\.py::test_never_a_number_without_a_warning\[((?!two_faults).*-[12]|two_faults-1.*)\]"
    r"|test_coverage\.py::test_a_small_version.*\[12-"
    r"|test_field_amplitudes\.py::.*\[figure2[01]"
    r"|test_field_loops\.py::"
    r"|test_stops\.py::test_a_frozen_host_is_no_watchdog_either"     # test_rows_process freezes one too
    r"|test_default_plan\.py::.*_filters\[three poles"
    r"|test_modbus_tcp\.py::test_a_connection_that_dies\[reset"      # test_modbus_scripted resets one too
    r"|path/test_modbus_profiles\.py::test_the_inertia\[generic/modbus"     # so does test_cli_modbus
    r"|test_stops\.py::test_a_(killed_host_.*|signal_in_each_stage)\[(SIGINT-)?hold"
)
"""More cases of what others show already, and minutes of it: with --long."""

TOGETHER = re.compile(
    r"study/test_(field_amplitudes|field_slopes|field_loops|tables|figures)\.py"
    r"|path/test_(report|cli_modbus|replay_csv)\.py"
    r"|identify/test_(default_plan|record_route|hopeless|properties)\.py"
    r"|(?P<several>identify)/test_(?:friction_curve|second_opinion)\.py"          # both look at the same runs
)
"""Files with an expensive fixture of their own; pytest-xdist gives each to one worker, so that it is made once."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the cases that are left out for their time")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):      # type: ignore[no-untyped-def]  # where pytest-xdist is installed
    """Not --dist loadgroup: with pytest 9, whose node-IDs pytest-xdist 3.8 can't mark, it groups nothing."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFixture(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            shared = TOGETHER.search(nodeid)
            return nodeid if shared is None else shared["several"] or shared.group()

    return ByFixture(config, log) if config.getvalue("dist") == "load" else None


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
