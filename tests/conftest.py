"""One setting for every property test: the same examples at every run. TDHIL_FUZZ=1 looks for new ones instead.

The longest cases run with --long only, heavy ones in CI (--heavy: those alone), which the header of every run says.

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

HEAVY = re.compile(
    r"protocol/test_design\.py::test_(it_repeats|stated_lags|the_chosen_motion.*\[(servo|heavy))"
    r"|path/test_field_rig\.py::.*(_inertia\[1\]|_identified\[1\])"
    r"|path/test_modbus_profiles\.py::.*\[siemens/(g120|s120)"
    r"|path/test_two_kernels\.py"
    r"|path/test_kill_at_random\.py"
    r"|path/test_stop_command\.py::test_(while_a_run|a_stepped_drive|where_nobody_is_reached\[json)"
    r"|path/test_stops\.py::test_(a_run_killed_late|a_signal_in_each_stage\[(SIGINT-(torque|speed)|SIGTERM)|a_dead_sim)"
    r"|path/test_streams\.py::test_nothing_is_loaded_once_the_shaft_may_move\[fault1"
    r"|path/test_real_peer\.py::test_a_wrong_word_moves_nothing\[(?!MOVE)"
    r"|path/test_five_stages\.py::.*(\[socketcand\]|test_ctrl_c)"
    r"|protocol/test_deaf\.py::.*--tolerance"
    r"|identify/test_bent_friction\.py::test_on_a_rig_with_stribeck"
    r"|identify/test_properties\.py::test_finds_the_truth_of_the_closed_form"
    r"|study/test_coverage(_interrupted)?\.py::test_(a_small_version.*\[4-|ctrl_c)"
    r"|study/test_field_amplitudes\.py::"
    r"|faults/test_modbus_tcp\.py::test_a_(connection_that_dies|killed_host)"
)
"""Half a minute each, or more of the same: left out of the README's command, run by .ci/run."""

TOGETHER = re.compile(
    r"study/test_(field_amplitudes|field_slopes|field_loops|tables|figures)\.py"
    r"|path/test_(report|cli_modbus|replay_csv)\.py"
    r"|identify/test_(default_plan|record_route|hopeless|properties)\.py"
    r"|(?P<several>identify)/test_(?:friction_curve|second_opinion)\.py"          # both look at the same runs
)
"""Files with an expensive fixture of their own; pytest-xdist gives each to one worker, so that it is made once."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the cases that are left out for their time")
    parser.addoption("--heavy", action="store_true", help="only the heavy cases, which CI runs beside the README's")


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
    heavy = config.getoption("--heavy")
    left_out = [item for item in items if LONG.search(item.nodeid) or bool(HEAVY.search(item.nodeid)) is not heavy]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


def pytest_report_header(config: pytest.Config) -> str:
    if config.getoption("--long"):
        return "long and heavy cases: run too"
    heavy = "ONLY THESE" if config.getoption("--heavy") else "LEFT OUT, run by .ci/run (--heavy)"
    return f"long cases: LEFT OUT, see LONG in tests/conftest.py (--long); heavy cases: {heavy}"
