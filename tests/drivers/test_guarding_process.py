"""Node guarding between two processes: the simulated drive behind tdhil's socketcand hub, and a host that disappears.

python-can's client sends a remote frame as a length without bytes. The hub recognises it. A foreign
socketcand server may convert it to a data frame. Then preflight refuses (see test_guarding).
"""

import csv
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, PowerState
from profiles.library import load_canopen_profile
from tests.path.path_runs import PATIENT

LIMITS = DriveLimits(speed_rad_s=15.0, torque_nm=300.0, quick_stop_rad_s2=2.0, watchdog_s=0.4)
NAME = "siemens/s120-canopen"


@pytest.fixture
def simulated(tmp_path):
    trace = tmp_path / "trace.csv"
    arguments = ["canopen", "--hub", "127.0.0.1:0", "--profile", NAME, "--seed", "1", "--trace", str(trace)]
    process = subprocess.Popen(
        [sys.executable, *map(str, PATIENT), *arguments], stdout=subprocess.PIPE, text=True,
        cwd=Path(__file__).parents[2],
    )
    line = process.stdout.readline()
    assert line.endswith(f"node 1 profile {NAME}\n")
    yield int(line.split()[2].rpartition(":")[2]), trace, process
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.mark.heavy
def test_after_the_end_of_the_host_the_shaft_comes_to_standstill(simulated):
    port, trace, process = simulated
    bus = can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0", tcp_tune=True)
    drive = CanopenDrive(bus, load_canopen_profile(NAME), SteppedClock(), node=1)
    drive.connect()
    found = drive.preflight(LIMITS)
    assert found.refused == ()
    assert next(check for check in found.checks if check.name == "watchdog").found == "100 ms x 4, answered"
    drive.enable(Mode.SPEED)
    for _ in range(700):
        sample = drive.exchange(Command(Mode.SPEED, 5.0, 0.0))
    assert sample.state is PowerState.ENABLED
    assert sample.speed_rad_s == pytest.approx(5.0, abs=0.3)
    bus.shutdown()                                           # no quick stop, no disable, no close
    deadline_s = time.monotonic() + 300.0
    rows = []
    while time.monotonic() < deadline_s:
        time.sleep(0.2)
        rows = list(csv.reader(trace.read_text(encoding="utf-8").splitlines()))[1:]
        if any(row[4:] == ["state: switch on disabled"] for row in rows[20:]):
            break
    process.terminate()
    process.wait(120.0)
    rows = list(csv.reader(trace.read_text(encoding="utf-8").splitlines()))[1:]
    lost = next(row for row in rows if row[4:] == ["host's node guarding lost"])
    ended = next(row for row in rows if row[4:] == ["state: switch on disabled"] and float(row[0]) > float(lost[0]))
    assert float(lost[1]) == pytest.approx(5.0, abs=0.3)
    assert float(ended[0]) - float(lost[0]) < 5.0 / 2.0 + 1.5      # the ramp set by preflight
    assert abs(float(rows[-1][1])) < 0.1
