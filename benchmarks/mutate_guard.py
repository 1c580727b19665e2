"""Deletes single statements of the lines that keep a shaft safe, one at a time: each deletion must make a test fail.

    python benchmarks/mutate_guard.py --sample 300 --out rows.jsonl   # of every subject some; 1 if one survives
    python benchmarks/mutate_guard.py                 # all of them, some 7,000
    python benchmarks/mutate_guard.py guard clock     # all of these subjects
    python benchmarks/mutate_guard.py --named         # single lines changed by hand that no test noticed once
    python benchmarks/mutate_guard.py --branches      # which branches of them the same tests leave out; 1 if any

Guard, observer and stop, the protocol's stages, every file of the drivers, the log's writer, what opens a drive and
ends a run, and `tdhil identify`; of the service what begins, stops and loses a run, who may do what, its audit and its
door. The benchmark works on copies in memory: it forks a child process per mutant, which replaces the function in
question (`prepared_tests`). Nothing in the checkout is written.

The tests of a subject run once as they are, which notes how long each takes and which functions it enters. A mutant
runs those that enter its function, the quick ones first, up to the first failure. Only a mutant that the usual tests
do not notice runs the heavy ones, too. A subject whose tests fail as it is comes first: nothing can be said of it.

`--out` keeps each mutant's outcome: the next call goes on where this one was stopped. A file that was changed since
begins anew; `--again` runs the survivors once more, for new tests.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import random
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from benchmarks.kept_rows import Row, drop_rows, kept_rows  # noqa: E402
from benchmarks.prepared_tests import (  # noqa: E402
    NOT_REPLACED,
    Changed,
    PreparedTests,
    Watch,
    forget,
    in_child,
    is_text,
    wait_for,
)

TESTS = ROOT / "tests"
OURS = ("drivers", "profiles", "sim_bus", "tdhil")


@dataclass(frozen=True)
class Subject:
    """A module below the root, the tests (below ``tests/``) that guard it, and what of it is meant (none: all).

    ``within``: names that stand at the module's top: functions, classes, constants. ``heavy``: the heavy tests run too.
    """

    path: str
    tests: tuple[str, ...]
    within: frozenset[str] = frozenset()
    heavy: bool = True

    @property
    def module(self) -> str:
        return self.path.removesuffix(".py").replace("/", ".")


def _run(name: str, *tests: str, within: str = "") -> Subject:
    return Subject(f"tdhil/runner/{name}.py", tuple(f"runner/{test}" for test in tests), frozenset(within.split()))


def _driver(name: str, *tests: str, within: str = "") -> Subject:
    return Subject(f"drivers/{name}.py", tuple(f"drivers/{test}" for test in tests), frozenset(within.split()))


def _service(name: str, *tests: str, within: str = "") -> Subject:
    tests = tuple(f"service/{test}" for test in tests)
    return Subject(f"tdhil/service/{name}.py", tests, frozenset(within.split()))


_STOP = (
    "test_stop.py", "test_stop_feedback.py", "test_stop_interrupted.py", "test_stop_patience.py",
    "test_stop_torque_off.py", "test_stop_in_between.py", "test_stop_string.py", "test_stop_polls.py",
    "test_stop_doubt.py", "test_stop_properties.py",
)
_RUNS = ("test_control_loop.py", "test_five_stages.py", "test_run_goes_wrong.py")
SUBJECTS = {
    "guard": _run("guard", "test_guard.py", "test_guard_prediction.py", "test_guard_follows.py", "test_kept_within.py"),
    "stop": _run("stop", *_STOP),
    "string_release": _run("string_release", *_STOP, "test_swinging_string.py"),
    "speed_check": Subject(
        "tdhil/runner/speed_check.py",
        ("runner/test_speed_check.py", "runner/test_speed_witness.py", "runner/test_angles.py",
         "faults/test_speed_unit.py"),
    ),
    "preconditions": _run("preconditions", "test_stop_string.py", within="_LETS_GO refuse_with_string"),
    **{
        f"observer/{name}": _run(f"observer/{name}", "test_observer.py", "test_standstill.py")
        for name in ("observer", "momentum_balance", "position_way", "shaft_bounds")
    },
    "observer/repeated_feedback": _run(
        "observer/repeated_feedback", "test_observer.py", "test_standstill.py", "test_guard.py",
    ),
    **{
        f"observer/{name}": _run(f"observer/{name}", "test_observer.py", "test_standstill.py", f"test_{name}.py")
        for name in ("revival", "runaway", "torque_following")
    },
    "observer/unanswered_torque": _run("observer/unanswered_torque", "test_unanswered_torque.py", "test_observer.py"),
    "observer/left_operation": _run("observer/left_operation", "test_left_operation.py", "test_stop_doubt.py"),
    "standstill": _run("standstill", "test_standstill.py", "test_stop_feedback.py"),
    "control_loop": _run("control_loop", "test_control_loop.py", "test_deaf.py", "test_run_goes_wrong.py"),
    "steady": _run("stages/steady", "test_steady.py", "test_swinging_string.py"),
    "setup": _run("stages/setup", *_RUNS, "test_run_refused.py"),
    "speed": Subject(
        "tdhil/runner/stages/speed.py",
        (*(f"runner/{name}" for name in _RUNS), "runner/test_swinging_string.py", "runner/test_speed_witness.py",
         "faults/test_speed_unit.py"),
    ),
    "torque": _run("stages/torque", *_RUNS, "test_braking_probe.py"),
    "hold": _run(
        "stages/hold", "test_kept_within.py", *_RUNS, "test_control.py",
        within="WINDOW_SHARE SETTLED_S MEAN_S TIMEOUT_S run_hold",
    ),
    "acquire": _run(
        "stages/acquire", "test_kept_within.py", *_RUNS, "test_dither.py", "test_adaptive_duration.py",
        within="Follower run_acquire _SegmentCourse",
    ),
    "acquire pulses": _run(
        "stages/acquire", "test_kept_within.py", "test_pulses.py", within="_LONGEST run_speed_changes _calm _coast"
    ),
    "braking_probe": _run(
        "stages/braking_probe", "test_braking_probe.py", "test_brake_pulse.py", "test_swinging_string.py",
    ),
    "impedance": _run("stages/impedance", "test_impedance_run.py"),
    "virtual_string": _run("stages/virtual_string", "test_virtual_string.py"),
    **{f"{bus}/scan": Subject(f"drivers/{bus}/scan.py", ("path/test_scan.py", "drivers/test_modbus_pdu.py"))
       for bus in ("canopen", "modbus")},
    "canopen/drive": _driver(
        "canopen/drive", "test_preflight.py", "test_trouble.py", "test_late_host.py", "test_drive_faults.py",
        "test_feedback.py", "test_sdo_feedback.py", "test_other_master.py", "test_supervision.py", "test_position.py",
        "test_guarding.py", "test_no_watchdog.py", "test_profile_preflight.py", "test_drive_contract.py",
        "test_watchdog_feed.py", "test_changed_feedback.py",
    ),
    "cia402/drive": _driver(
        "cia402/drive", "test_preflight.py", "test_trouble.py", "test_late_host.py", "test_drive_faults.py",
        "test_feedback.py", "test_sdo_feedback.py", "test_other_master.py", "test_supervision.py", "test_position.py",
        "test_guarding.py", "test_no_watchdog.py", "test_profile_preflight.py", "test_drive_contract.py",
        "test_cia402_without_bus.py",
    ),
    "clock": _driver("clock", "test_clock.py", "test_recent_cycles.py", "test_late_host.py", "test_drive_faults.py"),
    "cia402/limits": _driver(
        "cia402/limits", "test_preflight.py", "test_profile_preflight.py", "test_torque_offset.py",
    ),
    "canopen/supervision": _driver(
        "canopen/supervision", "test_preflight.py", "test_guarding.py", "test_other_master.py", "test_supervision.py",
        "test_changed_feedback.py", "test_watchdog_feed.py",
    ),
    "canopen/watchdog": _driver(
        "canopen/watchdog", "test_preflight.py", "test_no_watchdog.py", "test_guarding.py", "test_watchdog_feed.py",
        "test_angle_in_cycle.py", "test_changed_feedback.py", "test_other_master.py",
    ),
    "cia402/state_machine": _driver(
        "cia402/state_machine", "test_state_machine.py", "test_no_valid_state.py", "test_falling_out.py"
    ),
    "canopen/pdo_mapping": _driver("canopen/pdo_mapping", "test_pdo_mapping.py", "test_other_master.py"),
    "cia402/position": _driver(
        "cia402/position", "test_position.py", "test_angle_in_cycle.py", "test_profile_preflight.py"
    ),
    "canopen/slow_feedback": _driver("canopen/slow_feedback", "test_angle_in_cycle.py", "test_drive_contract.py"),
    "cia402/polling": _driver("cia402/polling", "test_sdo_feedback.py", "test_no_valid_state.py"),
    "canopen/other_master": _driver("canopen/other_master", "test_other_master.py", "test_falling_out.py"),
    "cia402/supervision": _driver(
        "cia402/supervision", "test_other_master.py", "test_changed_feedback.py", "test_supervision.py",
        "test_cia402_without_bus.py", "test_torque_offset.py",
    ),
    "angle": _driver("angle", "test_angle_in_cycle.py"),
    "speed loop": _driver("speed_loop", "test_speed_loop.py"),
    "standstill of a bare stop": _driver(
        "standstill", "test_standstill.py", "test_quick_stop.py", "test_modbus_quick_stop.py",
    ),
    "canopen/bounded_send": _driver("canopen/bounded_send", "test_bounded_send.py"),
    "bare stop": _driver(
        "quick_stop", "test_modbus_quick_stop.py", "test_no_valid_state.py", "test_quick_stop.py", "test_stop_table.py"
    ),
    "canopen/quick_stop": _driver("canopen/quick_stop", "test_quick_stop.py"),
    "cia402/quick_stop": _driver(
        "cia402/quick_stop", "test_quick_stop.py", "test_other_master.py", "test_cia402_without_bus.py",
    ),
    "cia402/watchdog": _driver(
        "cia402/watchdog", "test_preflight.py", "test_no_watchdog.py", "test_guarding.py", "test_watchdog_feed.py",
    ),
    "modbus/state_machine": _driver(
        "modbus/state_machine", "test_modbus_state_machine.py", "test_no_valid_state.py", "test_modbus_drive.py"
    ),
    "modbus/drive": _driver(
        "modbus/drive", "test_modbus_drive.py", "test_no_valid_state.py", "test_angle_in_cycle.py",
        "test_modbus_preflight.py", "test_modbus_other_master.py", "test_sdo_feedback.py", "test_drive_contract.py",
    ),
    "modbus/position": _driver("modbus/position", "test_position.py", "test_angle_in_cycle.py"),
    "modbus/tcp": _driver("modbus/tcp", "test_modbus_links.py"),
    "modbus/preflight": _driver(
        "modbus/preflight", "test_modbus_preflight.py", "test_modbus_wrongs.py", "test_modbus_drive.py",
        "test_modbus_announce.py", "test_modbus_temperature.py", "test_no_watchdog.py",
    ),
    "modbus/watchdog": _driver("modbus/watchdog", "test_modbus_preflight.py", "test_modbus_watchdog.py"),
    "modbus/parameters": _driver(
        "modbus/parameters", "test_modbus_preflight.py", "test_modbus_wrongs.py", "test_undo_journal.py",
    ),
    "modbus/quick_stop": _driver("modbus/quick_stop", "test_modbus_quick_stop.py"),
    "own_limits": _driver("own_limits", "test_preflight.py", "test_profile_preflight.py", "test_modbus_preflight.py"),
    "preflight": _driver(
        "preflight", "test_preflight.py", "test_profile_preflight.py", "test_no_watchdog.py", "test_modbus_preflight.py"
    ),
    "undo_journal": _driver("undo_journal", "test_undo_journal.py", "test_preflight.py"),
    "canopen/bus": _driver("canopen/bus", "test_bus.py", "test_stamps.py", "test_sdo.py", "test_trouble.py"),
    "canopen/sdo": _driver("canopen/sdo", "test_sdo.py", "test_trouble.py", "test_filters.py", "test_quick_stop.py"),
    "canopen/pdo": _driver(
        "canopen/pdo", "test_pdo_mapping.py", "test_feedback.py", "test_trouble.py", "test_changed_feedback.py",
        "test_other_master.py", "test_quick_stop.py", "test_late_host.py",
    ),
    "cia402/bus": _driver("cia402/bus", "test_cia402_without_bus.py", "test_ethercat_drive.py"),
    "cia402/cycle_period": _driver("cia402/cycle_period", "test_preflight.py", "test_ethercat_drive.py"),
    "cia402/description": _driver("cia402/description", "test_ethercat_drive.py"),
    "cia402/mapping": _driver(
        "cia402/mapping", "test_cyclic_layout.py", "test_objects.py", "test_pdo_mapping.py", "test_ethercat_drive.py",
    ),
    "cia402/sdo_client": _driver("cia402/sdo_client", "test_cyclic_layout.py", "test_sdo.py", "test_ethercat_drive.py"),
    "cia402/sdo_message": _driver("cia402/sdo_message", "test_cyclic_layout.py", "test_sdo.py"),
    "cia402/objects": _driver("cia402/objects", "test_objects.py", "test_sdo.py", "test_cia402_without_bus.py"),
    "cia402/preflight": _driver(
        "cia402/preflight", "test_preflight.py", "test_profile_preflight.py", "test_filters.py",
        "test_torque_offset.py", "test_cia402_without_bus.py", "test_undo_journal.py",
    ),
    "cia402/process_data": _driver(
        "cia402/process_data", "test_objects.py", "test_feedback.py", "test_cia402_without_bus.py",
        "test_profile_preflight.py",
    ),
    **{f"ethercat/{name}": Subject(
        f"drivers/ethercat/{name}.py",
        ("drivers/test_ethercat_drive.py", "drivers/test_drive_contract.py", "path/test_ethercat_path.py"))
       for name in ("drive", "mailbox", "pdo", "quick_stop", "raw", "scan", "segment", "station", "supervision")},
    "modbus/access": _driver("modbus/access", "test_modbus_preflight.py", "test_modbus_wrongs.py"),
    "modbus/codec": _driver("modbus/codec", "test_modbus_codec.py", "test_modbus_drive.py"),
    "modbus/cycle": _driver("modbus/cycle", "test_modbus_plan.py", "test_modbus_drive.py", "test_angle_in_cycle.py"),
    "modbus/identity": _driver("modbus/identity", "test_modbus_drive.py", "test_modbus_preflight.py"),
    "modbus/link": _driver("modbus/link", "test_modbus_links.py", "test_modbus_drive.py"),
    "modbus/other_master": _driver("modbus/other_master", "test_modbus_other_master.py"),
    "modbus/pdu": _driver("modbus/pdu", "test_modbus_pdu.py", "test_modbus_links.py"),
    "modbus/rtu": _driver("modbus/rtu", "test_modbus_links.py"),
    "modbus/temperature": _driver("modbus/temperature", "test_modbus_temperature.py"),
    "log_writer": Subject(
        "tdhil/recording/log_writer.py",
        ("recording/test_writer.py", "recording/test_round_trip.py", "recording/test_export.py"),
        frozenset({
            "STEPPED_QUEUE", "REAL_TIME_QUEUE", "ALIVE_EVERY_S", "_FULL", "RunWriter",
            "POLL_S", "CHUNK_WALL_S", "CHUNK_LOG_NS", "CHUNK_BYTES", "FRAMES", "Pump",
            "NUDGE", "WAKE_S", "LAG_S", "SPARE", "Backlog",
        }),
    ),
    "mcap_container": Subject(
        "tdhil/recording/mcap_container.py", ("recording/test_writer.py", "recording/test_round_trip.py")
    ),
    "log_files": Subject("tdhil/session/log_files.py", ("session/test_log_files.py", "cli/test_identify_end.py")),
    "service/supervisor": _service("supervisor", "test_lost_drive.py", "test_supervisor.py", "test_refused_plainly.py"),
    "service/run_process": _service("run_process", "test_run_process.py", "test_attended.py"),
    "service/access": _service("access", "test_access.py"),
    "service/attendance": _service("attendance", "test_attendance.py"),
    "service/audit": _service("audit", "test_store.py"),
    "service/door": _service("door", "test_door.py"),
    "service/run_channel": _service("run_channel", "test_run_channel.py", "test_supervisor.py", "test_lost_drive.py"),
    "service/drive_stop": _service("drive_stop", "test_drive_stop.py"),
    "service/accounts": _service("accounts", "test_access.py"),
    "service/run_state": _service("run_state", "test_run_state.py", "test_lost_run.py"),
    "service/store": _service("store", "test_store.py", "test_supervisor.py"),
    "service/start_request": _service("start_request", "test_attended.py", "test_supervisor.py", "test_api.py"),
    "session/open_drive": Subject(
        "tdhil/session/open_drive.py",
        ("session/test_open_drive.py", "path/test_hopeless_plan.py", "api/test_front_door.py")),
    "session/connection": Subject(
        "tdhil/session/connection.py", ("session/test_modbus_options.py", "session/test_bus_options.py")),
    "session/drive_lock": Subject("tdhil/session/drive_lock.py", ("session/test_drive_lock.py",)),
    "session/confirm": Subject(
        "tdhil/session/confirm.py",
        ("session/test_confirm_speed.py", "session/test_unverified.py", "cli/test_only_the_operator.py",
         "cli/test_no_watchdog.py", "calibration/test_calibrate_run.py"),
    ),
    "session/overrides": Subject("tdhil/session/overrides.py", ("session/test_unverified.py",)),
    "session/pace": Subject("tdhil/session/pace.py", ("session/test_pace.py",)),
    "session/real_time": Subject("tdhil/session/real_time.py", ("session/test_real_time.py",)),
    "session/kept": Subject("tdhil/session/kept.py", ("session/test_kept.py",)),
    "session/run_session": Subject(
        "tdhil/session/run_session.py", ("service/test_run_process.py", "cli/test_identify_end.py")
    ),
    "identify": Subject(
        "tdhil/cli/identify.py", ("cli/test_identify_end.py",), frozenset({"_run", "_finish", "_failed"})
    ),
    "stop_on_signals": Subject("tdhil/session/stop_signals.py", ("cli/test_identify_end.py",)),
}
NAMED: tuple[tuple[str, str, str], ...] = (
    ("cia402/drive", "stall_share * self._prepared.watchdog_s", "10.0 * stall_share * self._prepared.watchdog_s"),
    ("cia402/limits", 'limits.torque_nm, lsb, 16, "N·m", math.floor', 'limits.torque_nm, lsb, 16, "N·m", math.ceil'),
    ("cia402/limits", "return _rounded(one, limits.torque_nm * nm, per_lsb, math.floor)",
     "return _rounded(one, limits.torque_nm * nm, per_lsb, math.ceil)"),
    ("canopen/supervision", "self._every_s = min(HEARTBEAT_S, every_s)", "self._every_s = HEARTBEAT_S"),
    ("speed_check", "TOO_FAST = 2.0", "TOO_FAST = 4.0"),
    ("speed_check", "FASTEST_SHARE = 0.7", "FASTEST_SHARE = 1.4"),
    ("speed_check", "SILENT = 5", "SILENT = 500"),
    ("canopen/watchdog", "return time_ms / 5000.0", "return time_ms / 2500.0"),
    ("cia402/state_machine", "return State.UNKNOWN if state is State.NOT_READY else state", "return state"),
    ("modbus/tcp", "self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)", "pass"),
    ("modbus/watchdog", "good = LEAST_CYCLES * period_s <= value <= ", "good = value <= "),
    ("modbus/preflight", "            access.write(register, 0)\n", "            pass\n"),
    ("hold", "kept_within(ahead_nm + correction, loop.guard.least_torque_nm, limits.torque_nm)",
     "ahead_nm + correction"),
    ("acquire", "kept_within(torque_nm, -limits.torque_nm, limits.torque_nm)", "torque_nm"),
    ("acquire pulses", "while follower.time_s < end_s:", "while True:"),
    ("identify", "code = code or int(exit_code(error))", "pass"),
    ("identify", "        code = ExitCode.STOP_NOT_CONFIRMED\n", "        pass\n"),
    ("guard", "if sample.fresh and not self._mode.see(command.mode, sample):", "if False:"),
    ("guard", "if sample.fresh and not following.see(command.speed_rad_s, sample):", "if False:"),
    ("stop", "if not (self._fed and self._watched and", "if not (self._fed and"),
    ("preconditions", "if not preflight.quick_stop_holds:", "if preflight.quick_stop_holds is False:"),
    ("mcap_container", "if found.st_size < self._offset:", "if False:"),
    ("stop_on_signals", '"SIGQUIT", ', ""),
    ("service/run_process", "if (early := read_json(self.folder / STOP_FILE)) is not None:",
     "if (early := None) is not None:"),
    ("service/run_process", "        refuse_changed(path, self.request.rig_sha256)      # after", "        # after"),
    ("service/supervisor", "state = State.INTERRUPTED if seen else State.STOP_NOT_CONFIRMED",
     "state = State.INTERRUPTED"),
    ("service/supervisor", "stop = replace(status.stop, confirmed=seen, at_rest=now() if seen else None, **first)",
     "stop = replace(status.stop, confirmed=True, at_rest=now(), **first)"),
    ("service/supervisor", "            if same:\n                return seen",
     "            if True:\n                return seen"),
    ("service/audit", "if seal.anchor not in ends:", "if False:"),
    ("service/audit", "if head not in ends or not (sealed or head.number <= seal.plain):", "if head not in ends:"),
    ("service/door", "first = min(among, key=lambda one: one.rank)", "first = next(iter(among))"),
    ("service/drive_stop", "if found[\"at_rest\"] and found[\"same_drive\"] else", "if found[\"at_rest\"] else"),
)
"""(subject, what stands there, what it becomes): lines that could be changed unnoticed once, and what came anew."""

LEAST_S, LONGEST = 60.0, 4.0
"""Limit of a mutant's time, s, and as a multiple of its tests' time: an endless wait or loop counts as noticed."""
START_S = 60.0
"""Added to the limit, s: imports and collection."""
UNLIMITED_S = 1800.0
"""Limit of the tests as they are, s."""
LEAST_OF_EACH = 2
"""Least deletions of each subject in a sample."""

_FALLS_THROUGH = "the function's last line: what falls off its end gives None, which its only caller takes alike"
_POWER = "shows after a loss of power alone"
_FOR_MYPY = "stands in annotations alone, and those are never evaluated"
_ONLY_SOONER = "ends sooner what would end alike: it only saves time"
_A_PROCESS = "a process of its own loads the file and not the mutant; tests that begin one fail without the line"
EQUIVALENT = {
    "stop.py, _slow_down: return False (last)": _FALLS_THROUGH,
    "stop.py, _see_rest: return None (last)": _FALLS_THROUGH,
    "stop.py, _coast: return None (last)": _FALLS_THROUGH,
    "stop.py, _gets_slower: return False (last)": _FALLS_THROUGH,
    "stop.py, __init__: self._speed_rad_s = math.inf (last)": "what is seen first sets it in any case",
    "observer/left_operation.py, __init__: self._braking_nms = 0.0":
        "it is read only once a point has shown standstill, and this point sets it",
    "observer/unanswered_torque.py, __init__: self._impulse_nms = self._from_s = self._seen_s = 0.0":
        "the first point sets them",
    "observer/unanswered_torque.py, __init__: self._strained_s = 0.0 (last)": "the first point of each rule sets it",
    "observer/unanswered_torque.py, see: return None":
        "after the rows are cleared, a single point is younger than the time of a yield",
    "standstill.py, see: return False": "the time since this sample is 0, below the time to settle",
    **{f"{name}.py, module: {line}": _A_PROCESS for name in ("service/run_process", "service/drive_stop")
       for line in ("if __name__ == '__main__':", "sys.exit(main(sys.argv[1:]))")},
    **{f"{name}.py, module: Say = Callable[[str], None]": _FOR_MYPY
       for name in ("service/access", "service/door", "service/supervisor")},
    "session/drive_lock.py, _holder: return None": _FALLS_THROUGH,
    "session/drive_lock.py, _take: time.sleep(0.01)": "a pause between tries: without it they cost a core",
    "modbus/link.py, module: Serve = Callable[[int, bytes, float], tuple[bytes | None, float]]":
        "the name of a type; only annotations use it, and mypy needs it",
    "service/attendance.py, cycle: self._looking = False":
        "the board keeps the time of the first call: without it, each cycle costs more",
    "service/store.py, _ensure: with suppress(OSError):": "an index that is known to be good is opened once more",
    "service/audit.py, _verify: return None (last)": _FALLS_THROUGH,
    "service/audit.py, _add: file.flush()": _POWER,
    "service/audit.py, _add: os.fsync(file.fileno())": _POWER,
    "service/audit.py, _read: assert plain is not None": "says to mypy what the TypeError two lines on says as well",
    "service/run_process.py, answer: return {'status': self.board.status.plain()}":
        "the function's last line returns the same, and nothing between asks for this",
    "service/run_process.py, _run: self.stop.check(next_step='Nothing has moved')":
        "a stop is seen once more by the Runner, before it moves anything; here it only comes sooner",
    "service/attendance.py, _write: self._wake.clear()":
        "the thread then writes the same status again and again: a core is lost, and nothing else",
    "canopen/drive.py, check: if watch.quiet:": _ONLY_SOONER,
    "canopen/drive.py, check: return": _ONLY_SOONER,
    "string_release.py, __init__: self._mean_nm = self._smooth_nm = 0.0 (last)": "the first step sets both",
}
"""Deletions that change nothing that can be seen, and why. (mypy refuses them all the same.)"""


def path_of(subject: str) -> Path:
    return ROOT / SUBJECTS[subject].path


@cache
def text_of(subject: str) -> str:
    return path_of(subject).read_text("utf-8")


def deletable(tree: ast.Module) -> list[tuple[list[ast.stmt], int]]:
    """(the list that a statement stands in, its place); imports, names for others, texts and definitions stay."""
    found = []
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if not isinstance(block, list):
                continue
            for place, statement in enumerate(block):
                kept = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Pass)
                annotation = isinstance(statement, ast.AnnAssign) and statement.value is None
                about_names = ast.unparse(statement).startswith(("__all__ = ", "if TYPE_CHECKING:"))
                if not isinstance(statement, kept) and not is_text(statement) and not annotation and not about_names:
                    found.append((block, place))
    return found


def at_the_top(tree: ast.Module, statement: ast.stmt) -> set[str]:
    """Names that the statement, or the definition around it, binds at the module's top."""
    outer = next(top for top in tree.body if any(node is statement for node in ast.walk(top)))
    if isinstance(outer, (ast.FunctionDef, ast.ClassDef)):
        return {outer.name}
    return {node.id for node in ast.walk(outer) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}


@dataclass(frozen=True)
class Mutant:
    """A deletion. ``number``: place in `deletable`; ``function``: line of the innermost function around, 0 for none."""

    subject: str
    number: int
    line: int
    text: str
    function: int

    @property
    def key(self) -> str:
        """The same until the file changes."""
        return f"{self.subject} {self.number} {hashlib.sha256(text_of(self.subject).encode()).hexdigest()[:12]}"

    def tree(self) -> ast.Module:
        """The file without that statement."""
        tree = ast.parse(text_of(self.subject))
        block, place = deletable(tree)[self.number]
        block[place] = ast.copy_location(ast.Pass(), block[place])
        return ast.fix_missing_locations(tree)


def mutants(subject: str) -> list[Mutant]:
    """All deletions of a subject, with what and where in words."""
    tree, meant = ast.parse(text_of(subject)), SUBJECTS[subject].within
    around: dict[ast.AST, ast.FunctionDef] = {}
    for node in ast.walk(tree):                                  # outer ones first
        if isinstance(node, ast.FunctionDef):
            around.update(dict.fromkeys((inner for inner in ast.walk(node) if inner is not node), node))
    found = []
    for number, (block, place) in enumerate(deletable(tree)):
        gone = block[place]
        if meant and not at_the_top(tree, gone) & meant:
            continue
        within = around.get(gone)
        last = " (last)" if within is not None and within.body[-1] is gone else ""
        text = f"{'module' if within is None else within.name}: {ast.unparse(gone).splitlines()[0]}{last}"
        found.append(Mutant(subject, number, gone.lineno, f"{subject}.py, {text}",
                            0 if within is None else within.lineno))
    return found


def sample(subjects: list[str], count: int | None, seed: int) -> list[Mutant]:
    """All deletions; or ``count``, drawn by subject in proportion to its size, but at least `LEAST_OF_EACH` of each."""
    found = {subject: mutants(subject) for subject in subjects}
    if count is None:
        return [one for every in found.values() for one in every]
    whole, drawn = sum(map(len, found.values())), []
    for subject, every in found.items():
        share = min(len(every), max(LEAST_OF_EACH, round(count * len(every) / whole)))
        drawn += random.Random(f"{seed} {subject}").sample(every, share)
    return drawn


class Counted(ast.NodeTransformer):
    """Every test of an if, while, conditional expression or comprehension says which way it went; loops likewise."""

    def __init__(self) -> None:
        self.places: list[tuple[int, str]] = []

    def note(self, node: ast.expr, text: str) -> ast.expr:
        self.places.append((node.lineno, text))
        call = ast.Call(ast.Name("_went", ast.Load()), [ast.Constant(len(self.places) - 1), node], [])
        return ast.copy_location(call, node)

    def visit_If(self, node):
        self.generic_visit(node)
        node.test = self.note(node.test, "if " + ast.unparse(node.test))
        return node

    visit_While = visit_If

    def visit_IfExp(self, node):
        self.generic_visit(node)
        node.test = self.note(node.test, "if " + ast.unparse(node.test))
        return node

    def visit_For(self, node):
        self.generic_visit(node)
        self.places.append((node.lineno, "for " + ast.unparse(node.target)))
        number = len(self.places) - 1
        # Gone through to the end (False), or entered (True).
        for block, way in ((node.body, True), (node.orelse, False)):
            call = ast.Call(ast.Name("_went", ast.Load()), [ast.Constant(number), ast.Constant(way)], [])
            block.insert(0, ast.copy_location(ast.Expr(call), node))
        return node


def run_tests(subject: str, changed: Changed, watch: Watch, which: str) -> int:
    """Run pytest in this process, with the option ``which`` of tests/conftest.py. Return its exit code."""
    import pytest

    forget(SUBJECTS[subject].module, OURS)
    sys.meta_path.insert(0, changed)
    quiet = ["-q", "-x", "-p", "no:cacheprovider", "--no-header", "--hypothesis-seed=0", "-o", "addopts=",
             f"--rootdir={ROOT}", *([which] if which else [])]
    files = [str(TESTS / name) for name in SUBJECTS[subject].tests]
    return int(pytest.main([*quiet, "--import-mode=importlib", *files], [watch]))


def preload() -> None:
    """Import everything that each child needs and no mutant changes."""
    sys.path[:0] = [str(ROOT)]
    import hypothesis
    import numpy
    import pytest
    import scipy.optimize

    import drivers.drive
    import tdhil.errors
    import tdhil.estimation
    import tdhil.recording.run_log
    import tdhil.runner.design
    import tdhil.runner.excitation

    assert all((hypothesis, numpy, pytest, scipy.optimize, drivers.drive, tdhil.errors, tdhil.estimation,
                tdhil.runner.design, tdhil.runner.excitation, tdhil.recording.run_log))


def fork(subject: str, changed: Changed, longest_s: float, which: str, log: Path | None = None) -> int:
    """Run all tests in a child process. Return its exit code, below 0 for a signal."""
    return wait_for(in_child(lambda: run_tests(subject, changed, Watch(), which), log), longest_s)


_PREPARED: dict[tuple[str, str], PreparedTests] = {}


def prepared(subject: str, which: str) -> PreparedTests:
    """The tests of a subject; those of the subject before are closed. ``which``: '' or ``--heavy``."""
    for other in [key for key in _PREPARED if key[0] != subject]:
        _PREPARED.pop(other).close()
    if (subject, which) not in _PREPARED:
        _PREPARED[subject, which] = PreparedTests(
            SUBJECTS[subject].module, path_of(subject), partial(_run_prepared, subject, which), UNLIMITED_S
        )
    return _PREPARED[subject, which]


def _run_prepared(subject: str, which: str, changed: Changed, watch: Watch) -> int:
    return run_tests(subject, changed, watch, which)


class TestsFail(Exception):
    """They do so without a mutant."""


def noticed(subject: str, tree: ast.Module, function: int, *, usual: bool = False) -> tuple[bool, int]:
    """Return whether a test fails, and how many there were to run. ``function``: its line; ``usual``: no heavy tests.

    Raises TestsFail.
    """
    count = 0
    for which in ("", "--heavy") if SUBJECTS[subject].heavy and not usual else ("",):
        tests = prepared(subject, which)
        if (trace := tests.trace) is None:
            print(tests.said)
            raise TestsFail(subject)
        if not (chosen := trace.tests(function)):
            continue
        count += len(chosen)
        longest_s = max(LEAST_S, LONGEST * sum(trace.took_s[one] for one in chosen))
        code = tests.run(tree, chosen, longest_s) if tests.replaceable(function) else NOT_REPLACED
        if code == NOT_REPLACED:
            changed = Changed(SUBJECTS[subject].module, tree, path_of(subject))
            code = fork(subject, changed, START_S + longest_s, which)
        if code != 0:
            return True, count
    return False, count


def judged(mutant: Mutant, *, usual: bool = False) -> Row:
    """The row of a mutant. ``noticed``: None if the tests fail without the mutant, too."""
    begun_s = time.monotonic()
    found: bool | None = None
    count = 0
    with suppress(TestsFail):
        found, count = noticed(mutant.subject, mutant.tree(), mutant.function, usual=usual)
    return {"mutant": mutant.key, "subject": mutant.subject, "line": mutant.line, "text": mutant.text,
            "noticed": found, "tests": count, "took_s": round(time.monotonic() - begun_s, 1)}


def outcome(row: Row) -> str:
    if row["noticed"] is None:
        return "its tests fail as it is"
    return "noticed" if row["noticed"] else "argued" if row["text"] in EQUIVALENT else "SURVIVES"


def show(row: Row) -> None:
    if outcome(row) != "noticed":
        print(f"{outcome(row)}: line {row['line']}, {row['text']} ({row['tests']} tests)", flush=True)


def summary(rows: list[Row]) -> list[str]:
    """Print the counts by subject. Return the survivors."""
    for subject in dict.fromkeys(row["subject"] for row in rows):
        counts = Counter(outcome(row) for row in rows if row["subject"] == subject)
        print(f"{subject}.py: {counts.total()} deletions: " + ", ".join(f"{n} {what}" for what, n in counts.items()))
    counts = Counter(map(outcome, rows))
    good = counts["noticed"] + counts["argued"]
    print(f"{len(rows)} deletions, {counts['noticed']} noticed, {counts['argued']} argued, {len(rows) - good} not: "
          f"{100.0 * good / max(1, len(rows)):.1f} % noticed or argued")
    return [f"line {row['line']}, {row['text']}: {outcome(row)}" for row in rows
            if outcome(row) not in ("noticed", "argued")]


def named(subjects: list[str]) -> list[str]:
    """The changes by hand that no test noticed, or whose line is no longer there."""
    survivors = []
    for subject, old, new in NAMED:
        if subject not in subjects:
            continue
        text = text_of(subject)
        what = f"{subject}.py: {old.strip()} → {new.strip() or 'nothing'}"
        if text.count(old) != 1:
            survivors.append(f"{what}: found {text.count(old)} times")
            continue
        line = text[:text.index(old.strip())].count("\n") + 1
        functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)
                     and node.lineno < line <= (node.end_lineno or 0)]
        try:
            seen, _ = noticed(subject, ast.parse(text.replace(old, new)), functions[-1].lineno if functions else 0)
        except TestsFail:
            survivors.append(f"{subject}.py: its tests fail as it is")
            continue
        print(f"{'noticed ' if seen else 'SURVIVES'} {what}", flush=True)
        if not seen:
            survivors.append(what)
    return survivors


def branches(subject: str) -> list[str]:
    """The ways that no test takes."""
    tree = ast.parse(path_of(subject).read_text("utf-8"))
    counted, meant = Counted(), SUBJECTS[subject].within
    tree.body = [counted.visit(node) if not meant or at_the_top(tree, node) & meant else node for node in tree.body]
    tree = ast.fix_missing_locations(tree)
    with tempfile.TemporaryDirectory() as folder:
        report, log = Path(folder) / "went.json", Path(folder) / "log"
        every = "--all-but-long" if SUBJECTS[subject].heavy else ""
        seen: set[tuple[int, bool]] = set()

        def note(number, value):
            seen.add((number, bool(value)))
            return value

        def work() -> int:
            changed = Changed(SUBJECTS[subject].module, tree, path_of(subject))
            changed.extra["_went"] = note
            code = run_tests(subject, changed, Watch(), every)
            report.write_text(json.dumps(sorted(seen)))
            return code

        if wait_for(in_child(work, log), UNLIMITED_S) != 0:
            print(log.read_text()[-3000:])
            return [f"{subject}.py: its tests fail"]
        went = {(number, way) for number, way in json.loads(report.read_text())}
    wanted = {(number, way) for number in range(len(counted.places)) for way in (True, False)}
    missing = sorted(wanted - went)
    share = 100.0 * (1.0 - len(missing) / max(1, len(wanted)))
    print(f"{subject}.py: {len(wanted)} branches, {len(missing)} not taken, {share:.1f} %", flush=True)
    return [f"{subject}.py:{counted.places[number][0]}: {counted.places[number][1]} is never {way}"
            for number, way in missing]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", help=f"{', '.join(SUBJECTS)} (default: all)")
    parser.add_argument("--branches", action="store_true", help="branch coverage instead")
    parser.add_argument("--named", action="store_true", help="only the changes by hand")
    parser.add_argument("--sample", type=int, metavar="N", help="about so many deletions, of each subject its share")
    parser.add_argument("--seed", type=int, default=1, help="of the sample (1)")
    parser.add_argument("--within", default="", help="only in functions of these names, with commas between")
    parser.add_argument("--out", type=Path, help="the outcomes as JSON lines; deletions that stand there are not run")
    parser.add_argument("--usual", action="store_true", help="without the heavy tests; see --again")
    parser.add_argument("--again", action="store_true", help="run those again that are not noticed in --out")
    wanted = parser.parse_args()
    begun_s = time.monotonic()
    preload()
    left: list[str] = []
    subjects = wanted.subjects or list(SUBJECTS)
    if wanted.named:
        left += named(subjects)
    elif wanted.branches:
        for subject in subjects:
            left += branches(subject)
    else:
        names = {f" {name}: " for name in wanted.within.split(",") if name}
        drawn = [one for one in sample(subjects, wanted.sample, wanted.seed)
                 if not names or any(name in one.text for name in names)]
        if wanted.again and wanted.out is not None:
            drop_rows(wanted.out, lambda row: not row["noticed"])
        by_key = {one.key: one for one in drawn}
        rows = kept_rows(wanted.out, "mutant", by_key, lambda key: judged(by_key[key], usual=wanted.usual), show)
        left += summary([row for row in rows if row["mutant"] in by_key])
    for line in left:
        print(line)
    print(f"{time.monotonic() - begun_s:.0f} s")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
