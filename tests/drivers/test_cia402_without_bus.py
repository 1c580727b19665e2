"""Behaviour of `drivers.cia402` beyond the contract suite, over a dictionary of objects without frames."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.cia402.quick_stop import Cia402Target
from drivers.drive import Command, Mode, PowerState
from drivers.errors import CommunicationLost
from drivers.quick_stop import Ended, bare_stop
from tests.drivers.drive_benches import Run
from tests.drivers.memory_bench import WATCHDOG, MemoryBench, MemoryObjects

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run():
    return Run(MemoryBench())


def test_it_loads_no_bus():
    script = (
        "import sys, drivers.cia402.drive, drivers.cia402.quick_stop\n"
        "print(*sorted({'can', 'canopen', 'drivers.canopen', 'drivers.modbus', 'profiles.canopen'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_the_drive_in_memory_implements_the_contract_in_under_two_hundred_lines():
    """The count is of code, without blank lines, comments and docstrings."""
    tree = ast.parse((Path(__file__).parent / "memory_bench.py").read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body[:1] = []
    code = {line for node in ast.walk(tree) if isinstance(node, ast.stmt | ast.expr)
            for line in (node.lineno, node.end_lineno)}
    assert len(code) < 200


def test_bytes_of_an_object_are_changed_and_restored():
    memory = MemoryBench().memory
    objects, before = MemoryObjects(memory), memory.read(WATCHDOG)
    assert objects.change_bytes(*WATCHDOG, b"\x34\x12") == b"\x34\x12" == memory.read(WATCHDOG) != before
    assert objects.restore() == ()
    assert memory.read(WATCHDOG) == before


def lost(run, within_s):
    with pytest.raises(CommunicationLost) as caught:
        run.go(within_s, speed=5.0)
    return caught.value


@pytest.mark.parametrize(("key", "data", "title"), [
    ((0x6072, 0), b"\x10\x27", "the drive's own limit"),
    ((0x605A, 0), b"\0\0", "the quick-stop option"),
    ((0x2100, 0), b"\0\0", "the drive's watchdog"),
])
def test_a_setting_that_another_master_changes_ends_the_run_and_is_restored(run, key, data, title):
    run.turning(5.0)
    before = run.bench.memory.read(key)
    run.bench.memory.write(key, data)
    error = lost(run, 10.0)
    assert title in error.what and f"{key[0]:04X}h" in error.where
    assert run.bench.memory.read(key) == before


def test_a_setpoint_that_another_master_writes_ends_the_run(run):
    run.turning(5.0)
    run.bench.memory.live[0x60FF, 0] = ("<i", lambda: 123)
    assert "the target velocity is not what this host sent" in lost(run, 20.0).what


def test_a_host_that_feeds_no_more_leaves_the_shaft_to_the_watchdog(run):
    run.turning(5.0)
    run.drive.stop_feeding()
    samples = [run.drive.exchange(Command(Mode.SPEED, 5.0, 0.0)) for _ in range(round(8.0 / run.drive.period_s))]
    assert samples[-1].state is PowerState.QUICK_STOP
    braked = next(one for one in samples if one.state is PowerState.QUICK_STOP)
    assert braked.time_s - samples[0].time_s == pytest.approx(run.bench.limits.watchdog_s, abs=0.02)
    assert abs(run.bench.true_speed_rad_s) < 0.01
    run.bench.frames.clear()
    run.drive.disable()
    run.until(lambda sample: sample.state is PowerState.OFF, 0.1)
    assert not any(frame.outgoing for frame in run.bench.frames)         # 6040h was written as an object
    assert run.bench.memory.silent_s > run.bench.limits.watchdog_s


def test_a_quick_stop_that_another_master_reverses_is_written_as_an_object(run):
    """Its setpoints reach the drive after those of the host in every cycle, until all RPDOs are disabled."""
    run.turning(5.0)
    memory, bus = run.bench.memory, run.drive._bus
    cycle = memory.cycle

    def with_another_master(frame, period_s):
        if bus._enabled:
            memory.write((0x6040, 0), b"\x0f\0")
        return cycle(None, period_s)

    memory.cycle = with_another_master
    run.drive.quick_stop()
    run.go(8.0, speed=5.0)
    assert run.samples[-1].state is PowerState.QUICK_STOP
    assert abs(run.bench.true_speed_rad_s) < 0.01
    assert any("reversed or not executed" in one for one in run.drive.remarks())


def test_a_stop_outside_of_any_run_needs_objects_alone(run):
    """Each reading advances the simulated time."""
    run.turning(5.0)
    memory, clock, period_s = run.bench.memory, run.drive.clock, run.drive.period_s
    memory.write((0x2100, 0), b"\0\0")

    class Target(Cia402Target):
        def poll(self):
            for _ in range(5):
                memory.cycle(None, period_s)
            return super().poll()

    report = bare_stop(Target(MemoryObjects(memory), run.drive._profile, clock), clock)
    assert report.ended is Ended.AT_REST
    assert report.last.state is PowerState.QUICK_STOP
    assert abs(run.bench.true_speed_rad_s) < 0.01
