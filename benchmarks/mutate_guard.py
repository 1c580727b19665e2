"""Deletes every single statement of the lines that keep a shaft safe in turn: each deletion must make a test fail.

    python benchmarks/mutate_guard.py                 # all of it; 1 if a deletion survives
    python benchmarks/mutate_guard.py --branches      # which branches of them the same tests leave out; 1 if any
    python benchmarks/mutate_guard.py guard --jobs 2
    python benchmarks/mutate_guard.py --named         # single lines changed by hand that no test noticed once
    python benchmarks/mutate_guard.py clock --limit 20 --skip 40

Guard and stop, the protocol's stages, the drivers' time, limits, watchdogs and bare stops, the log's writer, and the
end of `tdhil identify`; of the service what begins, stops and loses a run, who may do what, its audit and its door.
Works on copies in memory: a child process per mutant is forked off this one, loads the changed module in the place of
the real one, and runs the module's tests up to the first failure. Nothing in the checkout is written. A subject whose
tests fail as it is comes first: nothing can be said of it.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.util
import json
import math
import os
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
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
    return Subject(f"tdhil/service/{name}.py", tests, frozenset(within.split()), heavy=False)


_STOP = (
    "test_stop.py", "test_stop_feedback.py", "test_stop_interrupted.py", "test_stop_patience.py",
    "test_stop_torque_off.py", "test_stop_in_between.py", "test_stop_string.py", "test_stop_polls.py",
)
_RUNS = ("test_control_loop.py", "test_five_stages.py", "test_run_goes_wrong.py")
SUBJECTS = {
    "guard": _run("guard", "test_guard.py", "test_guard_prediction.py", "test_guard_follows.py", "test_kept_within.py"),
    "stop": _run("stop", *_STOP),
    "string_release": _run("string_release", *_STOP),
    "speed_check": _run("speed_check", "test_speed_check.py", "test_angles.py", "test_five_stages.py"),
    "preconditions": _run("preconditions", "test_stop_string.py", within="_LETS_GO refuse_with_string"),
    **{
        f"observer/{name}": _run(f"observer/{name}", "test_observer.py", "test_standstill.py")
        for name in ("observer", "momentum_balance", "position_way", "repeated_feedback", "revival", "runaway",
                     "shaft_bounds", "torque_following", "unanswered_torque")
    },
    "standstill": _run("standstill", "test_standstill.py", "test_stop_feedback.py"),
    "control_loop": _run("control_loop", "test_control_loop.py", "test_deaf.py", "test_run_goes_wrong.py"),
    "steady": _run("stages/steady", "test_steady.py"),
    "setup": _run("stages/setup", *_RUNS, "test_run_refused.py"),
    "speed": _run("stages/speed", *_RUNS),
    "torque": _run("stages/torque", *_RUNS, "test_braking_probe.py"),
    "hold": _run(
        "stages/hold", "test_kept_within.py", *_RUNS, "test_control.py",
        within="WINDOW_SHARE SETTLED_S MEAN_S TIMEOUT_S run_hold",
    ),
    "acquire": _run(
        "stages/acquire", "test_kept_within.py", *_RUNS, "test_dither.py", "test_adaptive_duration.py",
        within="Follower run_acquire _dither_of _SegmentCourse",
    ),
    "acquire pulses": _run(
        "stages/acquire", "test_kept_within.py", "test_pulses.py", within="_LONGEST run_swings _calm _coast"
    ),
    "canopen/drive": _driver(
        "canopen/drive", "test_preflight.py", "test_trouble.py", "test_late_host.py", "test_drive_faults.py",
        "test_feedback.py", "test_sdo_feedback.py", "test_other_master.py", "test_supervision.py", "test_position.py",
        "test_guarding.py", "test_no_watchdog.py", "test_profile_preflight.py", "test_drive_contract.py",
    ),
    "cia402/drive": _driver(
        "cia402/drive", "test_preflight.py", "test_trouble.py", "test_late_host.py", "test_drive_faults.py",
        "test_feedback.py", "test_sdo_feedback.py", "test_other_master.py", "test_supervision.py", "test_position.py",
        "test_guarding.py", "test_no_watchdog.py", "test_profile_preflight.py", "test_drive_contract.py",
        "test_cia402_without_bus.py",
    ),
    "clock": _driver(
        "clock", "test_late_host.py", "test_drive_faults.py",
        within="RECENT LATE_SHARE RATES_HZ STALL_S STALL_CYCLES how_late quantile Ticks",
    ),
    "cia402/limits": _driver(
        "cia402/limits", "test_preflight.py", "test_profile_preflight.py",
        within="_LIMIT _TITLES set_limits note_temperature _set _count _rounded _limit _same",
    ),
    "canopen/supervision": _driver(
        "canopen/supervision", "test_preflight.py", "test_guarding.py", "test_other_master.py", "test_supervision.py",
        within="HEARTBEAT_S ANSWER_S SignOfLife _guarded",
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
    "cia402/read back": _driver(
        "cia402/supervision", "test_other_master.py", "test_changed_feedback.py",
        within="Group ReadBack _WatchedObject _shown",
    ),
    "angle": _driver("angle", "test_angle_in_cycle.py"),
    "bare stop": _driver("quick_stop", "test_modbus_quick_stop.py", "test_no_valid_state.py"),
    "canopen/quick_stop": _driver(
        "canopen/quick_stop", "test_quick_stop.py",
        within="BY_SDO_TRIES BY_RPDO_TRIES BURST BURST_PAUSE_S _RPDOS _CONTROLWORD CanopenTarget",
    ),
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
        "modbus/preflight", "test_modbus_preflight.py", "test_modbus_wrongs.py",
        within="SHARES ECHO_POLLS ECHO_POLL_S clear_setpoints check_setpoints _check_one",
    ),
    "modbus/watchdog": _driver("modbus/watchdog", "test_modbus_preflight.py", "test_modbus_watchdog.py"),
    "modbus/parameters": _driver(
        "modbus/parameters", "test_modbus_preflight.py", "test_modbus_wrongs.py",
        within="_SLACK RegisterSetting _LIMIT set_limits _write_limit own_speed_limits write_setting wanted_setting"
        " _unit",
    ),
    "modbus/quick_stop": _driver("modbus/quick_stop", "test_modbus_quick_stop.py"),
    "log_writer": Subject(
        "tdhil/recording/log_writer.py", ("recording/test_writer.py", "recording/test_round_trip.py"),
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
    "service/supervisor": _service("supervisor", "test_lost_drive.py", "test_supervisor.py"),
    "service/run_process": _service("run_process", "test_run_process.py", "test_attended.py"),
    "service/access": _service("access", "test_access.py"),
    "service/attendance": _service("attendance", "test_attendance.py"),
    "service/audit": _service("audit", "test_store.py"),
    "service/door": _service("door", "test_door.py"),
    "service/run_channel": _service("run_channel", "test_run_channel.py", "test_supervisor.py", "test_lost_drive.py"),
    "service/drive_stop": _service("drive_stop", "test_drive_stop.py"),
    "session/drive_lock": Subject("tdhil/session/drive_lock.py", ("session/test_drive_lock.py",)),
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

LONGEST_S, LONGEST = 90, 4
"""Time limit of a mutant, s, and as a multiple of the tests' usual time: an endless loop counts as found."""

_FALLS_THROUGH = "the function's last line: what falls off its end gives None, which its only caller takes alike"
_POWER = "shows after a loss of power alone"
_FOR_MYPY = "stands in annotations alone, and those are never evaluated"
_ONLY_SOONER = "ends sooner what would end alike: it only saves time"
_A_PROCESS = "a process of its own loads the file and not the mutant; tests that begin one fail without the line"
EQUIVALENT = {
    "stop.py, _slow_down: return False (last)": _FALLS_THROUGH,
    "stop.py, _see_rest: return None (last)": _FALLS_THROUGH,
    "stop.py, _gets_slower: return False (last)": _FALLS_THROUGH,
    "stop.py, __init__: self._speed_rad_s = math.inf (last)": "what is seen first sets it in any case",
    **{f"{name}.py, module: {line}": _A_PROCESS for name in ("service/run_process", "service/drive_stop")
       for line in ("if __name__ == '__main__':", "sys.exit(main(sys.argv[1:]))")},
    **{f"{name}.py, module: Say = Callable[[str], None]": _FOR_MYPY
       for name in ("service/access", "service/door", "service/supervisor")},
    "session/drive_lock.py, _holder: return None": _FALLS_THROUGH,
    "session/drive_lock.py, _take: time.sleep(0.01)": "a pause between tries: without it they cost a core",
    "service/audit.py, _verify: return None (last)": _FALLS_THROUGH,
    "service/audit.py, _add: file.flush()": _POWER,
    "service/audit.py, _add: os.fsync(file.fileno())": _POWER,
    "service/audit.py, _read: assert plain is not None": "says to mypy what the TypeError two lines on says as well",
    "service/run_process.py, answer: return {'status': self.board.status.plain()}":
        "the function's last line returns the same, and nothing between asks for this",
    "service/run_process.py, _run: self.stop.check(next_step='Nothing has moved')":
        "a stop is seen once more by the Runner, before it moves anything; here it only comes sooner",
    "canopen/drive.py, check: if watch.quiet:": _ONLY_SOONER,
    "canopen/drive.py, check: return": _ONLY_SOONER,
    "string_release.py, _yielding: assert self._reference_nm is not None": "says to mypy what its caller has just set",
}
"""Deletions that change nothing that can be seen, and why. (mypy refuses them all the same.)"""


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds one module: the changed one."""

    def __init__(self, name: str, tree: ast.Module, path: Path) -> None:
        self.name = name
        self.code = compile(tree, str(path), "exec")
        self.extra: dict[str, object] = {}

    def find_spec(self, fullname, path=None, target=None):
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.name else None

    def exec_module(self, module) -> None:
        vars(module).update(self.extra)
        exec(self.code, vars(module))


def path_of(subject: str) -> Path:
    return ROOT / SUBJECTS[subject].path


def is_text(statement: ast.stmt) -> bool:
    """A docstring, of a module, a class, a function or a constant."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


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


def mutants(subject: str):
    """(line, what and where in words, tree without that statement), one by one."""
    text = path_of(subject).read_text("utf-8")
    for number in range(len(deletable(ast.parse(text)))):
        tree = ast.parse(text)
        block, place = deletable(tree)[number]
        gone = block[place]
        within = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and gone in ast.walk(node)]
        name = within[-1].name if within else "module"
        if SUBJECTS[subject].within and not at_the_top(tree, gone) & SUBJECTS[subject].within:
            continue
        last = " (last)" if within and within[-1].body[-1] is gone else ""
        block[place] = ast.copy_location(ast.Pass(), gone)
        yield gone.lineno, f"{name}: {ast.unparse(gone).splitlines()[0]}{last}", ast.fix_missing_locations(tree)


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


def run_tests(subject: str, changed: Changed) -> int:
    """Run pytest in this process. Return its exit code."""
    import pytest

    forget(SUBJECTS[subject].module)
    sys.meta_path.insert(0, changed)
    quiet = ["-q", "-x", "-p", "no:cacheprovider", "--no-header", "--hypothesis-seed=0", "-o", "addopts=",
             *(["--all-but-long"] if SUBJECTS[subject].heavy else [])]
    files = [str(TESTS / name) for name in SUBJECTS[subject].tests]
    return int(pytest.main([*quiet, "--import-mode=importlib", *files]))


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


def forget(module: str) -> None:
    """Unload our modules, so that none keeps a reference to a loaded subject."""
    if module in sys.modules:
        for name in [name for name in sys.modules if name.split(".")[0] in OURS]:
            del sys.modules[name]


def fork(subject: str, changed: Changed, report: Path | None = None, longest_s: float = 900.0) -> int:
    """The child's process number."""
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        signal.alarm(math.ceil(longest_s))
        folder = tempfile.mkdtemp(prefix="mutate-")
        os.chdir(folder)
        hush = os.open(os.devnull if report is None else str(report) + ".log", os.O_WRONLY | os.O_CREAT)
        os.dup2(hush, 1)
        os.dup2(hush, 2)
        went: set[tuple[int, bool]] = set()

        def note(number, value):
            went.add((number, bool(value)))
            return value

        changed.extra["_went"] = note
        code = run_tests(subject, changed)
        if report is not None:
            report.write_text(json.dumps(sorted(went)))
    finally:
        os._exit(code)


def delete_all(
    subject: str, jobs: int, longest_s: float, skip: int = 0, limit: int | None = None, within: str = ""
) -> list[str]:
    """The deletions that no test noticed."""
    name = SUBJECTS[subject].module
    running: dict[int, tuple[int, str]] = {}
    survivors: list[str] = []
    count = alike = 0

    def reap() -> None:
        nonlocal alike
        child, status = os.wait()
        line, text = running.pop(child)
        if os.waitstatus_to_exitcode(status) != 0:
            return
        if text in EQUIVALENT:
            alike += 1
        else:
            survivors.append(f"line {line}, {text}")
            print(f"SURVIVES {survivors[-1]}", flush=True)

    wanted = (one for one in mutants(subject) if not within or one[1].split(":")[0] in within.split(","))
    for line, text, tree in islice(wanted, skip, None if limit is None else skip + limit):
        count += 1
        while len(running) >= jobs:
            reap()
        child = fork(subject, Changed(name, tree, path_of(subject)), longest_s=longest_s)
        running[child] = line, f"{subject}.py, {text}"
    while running:
        reap()
    noticed = count - alike - len(survivors)
    print(f"{subject}.py: {count} deletions, {noticed} noticed, {alike} alike, {len(survivors)} survive", flush=True)
    return survivors


def as_it_is(subject: str) -> float | None:
    """Return the time limit of a mutant from the time of the unchanged tests; None if they fail."""
    tree = ast.parse(path_of(subject).read_text("utf-8"))
    begun_s = time.monotonic()
    _, status = os.waitpid(fork(subject, Changed(SUBJECTS[subject].module, tree, path_of(subject))), 0)
    took_s = time.monotonic() - begun_s
    return None if os.waitstatus_to_exitcode(status) != 0 else max(LONGEST_S, LONGEST * took_s)


def named(subjects: list[str]) -> list[str]:
    """The changes by hand that no test noticed, or whose line is no longer there."""
    survivors, longest_s = [], {}
    for subject, old, new in NAMED:
        if subject not in subjects:
            continue
        if subject not in longest_s:
            longest_s[subject] = as_it_is(subject)
        allowed_s = longest_s[subject]
        if allowed_s is None:
            survivors.append(f"{subject}.py: its tests fail as it is")
            continue
        text = path_of(subject).read_text("utf-8")
        what = f"{subject}.py: {old.strip()} → {new.strip() or 'nothing'}"
        if text.count(old) != 1:
            survivors.append(f"{what}: found {text.count(old)} times")
            continue
        changed = Changed(SUBJECTS[subject].module, ast.parse(text.replace(old, new)), path_of(subject))
        _, status = os.waitpid(fork(subject, changed, longest_s=allowed_s), 0)
        noticed = os.waitstatus_to_exitcode(status) != 0
        print(f"{'noticed ' if noticed else 'SURVIVES'} {what}", flush=True)
        if not noticed:
            survivors.append(what)
    return survivors


def branches(subject: str) -> list[str]:
    """The ways that no test takes."""
    tree = ast.parse(path_of(subject).read_text("utf-8"))
    counted, meant = Counted(), SUBJECTS[subject].within
    tree.body = [counted.visit(node) if not meant or at_the_top(tree, node) & meant else node for node in tree.body]
    tree = ast.fix_missing_locations(tree)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "went.json"
        _, status = os.waitpid(fork(subject, Changed(SUBJECTS[subject].module, tree, path_of(subject)), report), 0)
        if os.waitstatus_to_exitcode(status) != 0:
            print(Path(str(report) + ".log").read_text()[-3000:])
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
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--within", default="", help="only in functions of these names, with commas between")
    parser.add_argument("--skip", type=int, default=0, help="so many deletions of each subject")
    parser.add_argument("--limit", type=int, default=None, help="at most so many of each")
    wanted = parser.parse_args()
    begun_s = time.monotonic()
    preload()
    left: list[str] = []
    subjects = wanted.subjects or list(SUBJECTS)
    if wanted.named:
        left += named(subjects)
        subjects = []
    for subject in subjects:
        if wanted.branches:
            left += branches(subject)
        elif (longest_s := as_it_is(subject)) is None:
            left.append(f"{subject}.py: its tests fail as it is")
        else:
            left += delete_all(subject, wanted.jobs, longest_s, wanted.skip, wanted.limit, wanted.within)
    for line in left:
        print(line)
    print(f"{time.monotonic() - begun_s:.0f} s")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
