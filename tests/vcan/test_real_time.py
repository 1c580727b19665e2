"""Four runs in real time, each at its chosen rate, with simulated drives in their own processes.

A guest beside other tests is a slow and busy computer with late frames, bursts and stalls. On any computer, a run gives
a covering interval of J or none, or it ends with 5 and reports that this computer was late. It names no other cause,
and the shaft comes to standstill. benchmarks/real_time_runs.py measures the share of a hundred longer runs that
complete on a normal computer, and their missed cycles.

A run mostly waits, so two run in parallel if root can make a second interface. Each lane is a fork of this process,
since a guest starts programs slowly, with its own drive and interface. The tests wait for the results.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tdhil.recording.log_reader import read_run
from tdhil.runner.stages import speed
from tests.path.path_runs import INERTIA, PLAIN, Peer, identify, peer, wait_for
from tests.vcan.vcan_runs import root_s_ip, run

RUNS = 4
FURTHER = ("vcan8",)
SHORT = ("--mode", "speed", "--excitation", "sine", "--frequency", 1, "--periods", 12, "--offset", 5)
"""Twelve seconds of excitation at one mean speed."""
LEVEL_S, FIRST_RAMP_S = 2.0, 4.0
"""Times of stage 2, instead of 6 and 8 s. A less accurate J only makes the plan more cautious."""
A_RUN_S = 600.0
"""Wall time after which a run is considered hung, on a loaded guest."""


@dataclass(frozen=True)
class Answer:
    """End of one run in its lane."""

    code: int
    err: str
    document: dict[str, Any]
    log: Path
    last_speed_rad_s: float


class Lane:
    """Lane of consecutive runs in its own process."""

    def __init__(self, drive: Peer, folder: Path, numbers: range) -> None:
        self.drive, self.folder = drive, folder
        self._child = multiprocessing.get_context("fork").Process(target=self._go, args=(numbers,))
        self._child.start()

    def answer(self, number: int) -> Answer:
        """Wait for the result and return it."""
        path = self.folder / f"{number}.json"
        wait_for(f"run {number}", lambda: path.exists() or not self._child.is_alive(), hangs_s=A_RUN_S)
        assert path.exists(), f"the lane ended before run {number}: exit {self._child.exitcode}"
        found = json.loads(path.read_text())
        return Answer(log=Path(found.pop("log")), **found)

    def end(self) -> None:
        self._child.kill()
        self._child.join()

    def _go(self, numbers: range) -> None:
        os.environ["HOME"] = str(self.folder)          # no bus of the user
        os.chdir(self.folder)
        speed.LEVEL_S, speed.FIRST_RAMP_S = LEVEL_S, FIRST_RAMP_S
        for number in numbers:
            done = identify(self.folder, *self.drive.options, *SHORT, log=f"{number}.mcap")
            # A stop for lateness before motion is a refusal with its own log.
            log = self.folder / f"{number}.mcap"
            log = log if log.exists() else log.with_suffix(".refused.mcap")
            answer = self.folder / f"{number}.json"
            part = answer.with_suffix(".part")
            part.write_text(json.dumps({
                "code": done.code, "err": done.err, "document": json.loads(done.out), "log": str(log),
                "last_speed_rad_s": float(self.drive.shaft.speed_rad_s[-1]),
            }))
            part.rename(answer)


@contextmanager
def further_interface(name: str) -> Iterator[list[str]]:
    """Make a further interface if links may be changed."""
    ip = root_s_ip()
    if ip is None or subprocess.run([ip, "link", "add", name, "type", "vcan"], check=False).returncode:
        yield []
        return
    try:
        run(ip, "link", "set", name, "up", "txqueuelen", "1000")
        yield [name]
    finally:
        run(ip, "link", "del", name)


def go_first(drive: Peer) -> None:
    """Raise the priority of the simulated drive: a real drive has its own processor and never waits for the host."""
    for thread in Path(f"/proc/{drive.child.pid}/task").iterdir():
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, int(thread.name), -15)


@pytest.fixture(scope="module")
def lanes(tmp_path_factory):
    with ExitStack() as stack:
        names = [os.environ.get("TDHIL_VCAN") or "vcan0"]
        for name in FURTHER:
            names += stack.enter_context(further_interface(name))
        found = []
        for index, name in enumerate(names):
            folder = tmp_path_factory.mktemp(name)
            options = ("-i", "socketcan", "-c", name, "--seed", 5 + index)
            drive = stack.enter_context(peer(folder, *options, program=PLAIN))
            go_first(drive)
            found.append((drive, folder, range(index, RUNS, len(names))))
        lanes = [Lane(*one) for one in found]
        for lane in lanes:
            stack.callback(lane.end)
        yield lanes


@pytest.mark.parametrize("number", range(RUNS))
def test_a_run_gives_its_result_or_reports_that_this_computer_was_late(lanes, number):
    lane = lanes[number % len(lanes)]
    done = lane.answer(number)
    assert done.log.exists(), done.err
    configuration = read_run(done.log).configuration
    print(f"exit {done.code}, {configuration.get('cycle')}, {configuration['counters']}")
    if "cycle" in configuration:
        assert [one["rate_hz"] for one in configuration["rate_tried"]][-1] == configuration["cycle"]["rate_hz"]
    if done.code == 5:
        said = done.document["error"]["message"]
        assert said.startswith("host"), said
        assert "another node" not in said and "another master" not in said
        assert "supply" not in said
    else:
        assert done.code in (0, 9), done.err
        assert "cycle" in configuration
        j = done.document["inertia_kg_m2"]
        assert j is None or not math.isfinite(j["low"]) or j["low"] <= INERTIA <= j["high"], j
    assert abs(done.last_speed_rad_s) < 0.05
    lane.drive.shaft.assert_never_let_go()
