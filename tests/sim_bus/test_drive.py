"""Drive in motion over the bus: modes, limits, stops, faults, watchdog."""

import math
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from sim_bus.params import RigParams

Open = Callable[..., tuple[Any, Any]]
RPM_TENTH = 2.0 * math.pi / 600.0


def state(status: int) -> str:
    return {0x40: "off", 0x21: "ready", 0x23: "on", 0x27: "enabled", 0x07: "quick stop", 0x0F: "reaction",
            0x08: "fault"}[status & (0x4F if status & 0x48 in (0x40, 0x08) or status & 0x4F == 0x0F else 0x6F)]


def until_at_rest(host: Any, word: int, most: int = 1500, **setpoints: int) -> int:
    """Run cycles until the drive reports standstill (bit 10 or a state without torque)."""
    for count in range(most):
        status, _, speed = host.cycle(word, **setpoints)
        if abs(speed) < 3 and (status & 0x0400 or state(status) in ("off", "fault")):
            return count
    raise AssertionError("never at rest")


def test_path_to_operation_and_back(bench: Open) -> None:
    _, host = bench()
    host.set_up()
    words = [(0x06, "ready"), (0x07, "on"), (0x0F, "enabled"), (0x07, "on"), (0x06, "ready"), (0x0F, "enabled"),
             (0x06, "ready"), (0x00, "off"), (0x0F, "off"), (0x06, "ready"), (0x02, "off")]
    host.write(0x605C, 0, 0, 2)
    assert [state(host.cycle(word)[0]) for word, _ in words] == [name for _, name in words]
    status = host.cycle(0x00)[0]
    assert status & 0x0210 == 0x0210                              # remote, voltage enabled


@pytest.mark.heavy
def test_cyclic_velocity_and_torque_with_a_switch_while_enabled(bench: Open) -> None:
    simulated, host = bench()
    host.set_up()
    host.enable(velocity=300)
    status, torque, speed = host.cycle(velocity=300, times=2000)
    assert abs(speed - 300) <= 1 and status & 0x1000
    assert torque == pytest.approx(60 + 8 * 300 * RPM_TENTH, abs=2)
    host.cycle(torque=torque, velocity=300)
    host.write(0x6060, 0, 10, 1)
    assert host.read(0x6061) == 10
    after = [host.cycle(torque=torque, velocity=300)[1] for _ in range(50)]
    assert max(after) - min(after) <= 1
    assert simulated.simulator.speed_rad_s == pytest.approx(300 * RPM_TENTH, rel=0.02)
    host.write(0x6060, 0, 9, 1)
    assert abs(host.cycle(torque=torque, velocity=300, times=50)[1] - torque) <= 3


@pytest.mark.heavy
def test_profile_velocity_ramps_and_reaches(bench: Open) -> None:
    _, host = bench()
    host.set_up(mode=3)
    host.enable()
    assert host.cycle(times=20)[0] & 0x1000                       # speed is zero
    begin = host.cycle(velocity=300)[2]
    assert begin == 0
    demand = [host.read(0x606B, signed=True) for _ in range(100) if host.cycle(velocity=300)]
    assert demand[99] == pytest.approx(101, abs=2)                # 100 LSB/s for 1 s
    status = host.cycle(velocity=300, times=2000)[0]
    assert status & 0x0400 and not status & 0x1000


def test_profile_torque_ramps_by_its_slope(bench: Open) -> None:
    _, host = bench()
    host.set_up(mode=4)
    host.enable()
    host.cycle(torque=100)
    assert host.read(0x6074, signed=True) == 1
    assert not host.cycle(torque=100, times=50)[0] & 0x0400
    assert host.cycle(torque=100, times=60)[0] & 0x0400
    assert host.read(0x6074, signed=True) == 100


@pytest.mark.heavy
def test_limits_show_in_bit_11(bench: Open) -> None:
    simulated, host = bench()
    host.set_up(mode=10)
    host.write(0x6072, 0, 150, 2)
    host.write(0x6080, 0, 30, 4)
    host.enable()
    status, torque, _ = host.cycle(torque=300, times=30)
    assert torque == 150 and status & 0x0800
    assert not host.cycle(torque=140, times=5)[0] & 0x0800
    status, _, speed = host.cycle(torque=140, times=3000)
    assert speed == pytest.approx(300, abs=3) and status & 0x0800   # 30 rpm
    assert simulated.simulator.speed_rad_s < 3.3
    host.write(0x60E0, 0, 20, 2)
    assert host.cycle(torque=140, times=30)[1] == 20


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("mode", [9, 10])
@pytest.mark.parametrize(("option", "end"), [(0, "off"), (1, "off"), (2, "off"), (3, "off"), (5, "quick stop"),
                                             (6, "quick stop"), (7, "quick stop")])
def test_quick_stop_options(bench: Open, option: int, end: str, mode: int) -> None:
    simulated, host = bench()
    host.set_up()
    host.write(0x605A, 0, option, 2)
    host.enable(velocity=200)
    torque = host.cycle(velocity=200, times=1500)[1]
    host.cycle(torque=torque, velocity=200)
    host.write(0x6060, 0, mode, 1)
    status = host.cycle(0x02, torque=torque, velocity=200)[0]
    assert state(status) == ("off" if option == 0 else "quick stop")
    cycles = until_at_rest(host, 0x02, torque=torque, velocity=200)
    status = host.cycle(0x02, torque=torque, velocity=200, times=20)[0]
    assert state(status) == end and simulated.simulator.speed_rad_s == pytest.approx(0.0, abs=0.01)
    wanted_s = {1: 2.0, 5: 2.0, 2: 200 / 300, 6: 200 / 300}.get(option)
    if wanted_s is not None:
        assert wanted_s - 0.1 < cycles * 0.01 < wanted_s + 1.2
    resumed = state(host.cycle(0x0F)[0])
    assert resumed == ("enabled" if option >= 5 else "off")


@pytest.mark.heavy
def test_halt_stays_enabled_and_can_be_released(bench: Open) -> None:
    simulated, host = bench()
    host.set_up()
    host.enable(velocity=200)
    host.cycle(velocity=200, times=1000)
    until_at_rest(host, 0x010F, velocity=200)
    status = host.cycle(0x010F, velocity=200)[0]
    assert state(status) == "enabled" and status & 0x0400
    host.cycle(0x000F, velocity=200, times=1000)
    assert simulated.simulator.speed_rad_s == pytest.approx(200 * RPM_TENTH, abs=0.05)


@pytest.mark.heavy
def test_disable_operation_with_ramp_waits_for_rest_and_disable_voltage_does_not(bench: Open) -> None:
    simulated, host = bench()
    host.set_up()
    host.enable(velocity=200)
    host.cycle(velocity=200, times=1000)
    assert state(host.cycle(0x07, velocity=200)[0]) == "enabled"       # 605Ch = 1: slows down first
    for _ in range(1500):
        if state(host.cycle(0x07, velocity=200)[0]) == "on":
            break
    assert abs(simulated.simulator.speed_rad_s) < 0.06
    host.cycle(0x0F, velocity=200, times=1000)
    assert state(host.cycle(0x00, velocity=200)[0]) == "off"
    assert simulated.simulator.speed_rad_s > 1.9                          # coasting


def watched(host: Any, option: int, behaviour: int = 1) -> None:
    host.set_up()
    host.write(0x6007, 0, option, 2)
    host.write(0x1029, 1, behaviour, 1)
    host.write(0x1016, 1, 127 << 16 | 100, 4)
    host.enable(velocity=200)
    host.cycle(velocity=200, times=1000)                                  # no heartbeat yet: no supervision
    assert host.emcy() == []
    for _ in range(10):
        host.send(0x77F, b"\x05")
        host.cycle(velocity=200, times=5)
    assert host.emcy() == []


@pytest.mark.heavy
@pytest.mark.parametrize(("option", "first", "last"), [
    (0, "enabled", "enabled"), (1, "reaction", "fault"), (2, "off", "off"), (3, "quick stop", "off"),
])
def test_watchdog_reactions(bench: Open, option: int, first: str, last: str) -> None:
    simulated, host = bench()
    watched(host, option)
    status = host.cycle(velocity=200, times=13)[0]
    assert host.emcy() == [0x8130] and status & 0x80                      # warning
    assert state(status) == first
    status = host.cycle(velocity=200, times=1500)[0]                      # further setpoints do not restart it
    assert state(status) == last
    assert abs(simulated.simulator.speed_rad_s) < 0.06 or option == 0
    assert host.read(0x1001) == 0x11 and host.read(0x603F) == 0x8130 and host.read(0x1003, 1) == 0x8130
    host.send(0x77F, b"\x05")
    status = host.cycle(velocity=200)[0]
    assert not status & 0x80
    if option == 1:
        assert state(host.cycle(0x00)[0]) == "fault" and host.read(0x1001) == 0x11
        assert state(host.cycle(0x80)[0]) == "off"
    assert host.emcy()[-1] == 0 and host.read(0x1001) == 0 and host.read(0x1003) == 1


@pytest.mark.heavy
def test_a_stop_of_the_watchdog_is_not_undone_by_the_old_word(bench: Open) -> None:
    _, host = bench()
    host.write(0x605A, 0, 6, 2)
    watched(host, 3)
    assert state(host.cycle(velocity=200, times=700)[0]) == "quick stop"
    host.cycle(0x02)
    assert state(host.cycle(0x0F)[0]) == "enabled"


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("behaviour", "nmt"), [(0, 127), (1, 5), (2, 4)])
def test_error_behaviour(bench: Open, behaviour: int, nmt: int) -> None:
    simulated, host = bench()
    watched(host, 3, behaviour)
    for _ in range(20):
        host.send(0x080)
    host.nmt(128 if nmt == 4 else 99)                                       # enables SDO again, as a barrier
    host.read(0x1000)
    assert [1 for can_id, data in host.heard if can_id == 0x081]
    assert simulated.simulator.node.nmt.state == (127 if nmt == 4 else nmt)


@pytest.mark.heavy
def test_reset_needs_an_edge(bench: Open) -> None:
    _, host = bench()
    watched(host, 1)
    host.cycle(0x8F, velocity=200, times=1000)                             # bit 7 high all the while
    assert state(host.cycle(0x8F)[0]) == "fault"
    assert state(host.cycle(0x0F)[0]) == "fault"
    assert state(host.cycle(0x80)[0]) == "off"


def test_nmt_stop_while_turning_acts_like_a_lost_connection(bench: Open) -> None:
    simulated, host = bench()
    host.set_up()
    host.write(0x6007, 0, 3, 2)
    host.enable(velocity=200)
    host.cycle(velocity=200, times=1000)
    host.nmt(2)
    for _ in range(400):
        host.send(0x080)
    host.nmt(1)
    assert state(host.cycle(0x00)[0]) == "off" and abs(simulated.simulator.speed_rad_s) < 0.06


def run_frames(bench: Open, seed: int) -> list[tuple[int, int, int]]:
    _, host = bench(RigParams(), seed=seed)
    host.set_up(period_us=4000)
    host.enable(velocity=250)
    return [host.cycle(velocity=250) for _ in range(400)]


@pytest.mark.heavy
def test_same_seed_same_frames(bench: Open) -> None:
    first = run_frames(bench, 7)
    assert first == run_frames(bench, 7)
    assert first != run_frames(bench, 8)


def test_trace_and_silence(bench: Open, tmp_path: Path) -> None:
    path = tmp_path / "shaft.csv"
    simulated, host = bench(trace=path)
    watched(host, 3)
    simulated.simulator._time.silence_s = 0.05          # from here on; before, the host on a busy computer may be slow
    deadline = time.monotonic() + 120.0
    while "state: switch on disabled" not in path.read_text() and time.monotonic() < deadline:
        time.sleep(0.02)                                                    # the host sends nothing
    lines = path.read_text().splitlines()
    assert lines[0] == "time_s,speed_rad_s,torque_nm,state,event"
    rows = [line.split(",") for line in lines[1:]]
    events = [row[4] for row in rows if row[4]]
    order = ["host silent: running on in own time", "host heartbeat lost", "state: quick stop active",
             "state: switch on disabled"]
    assert [event for event in events if event in order][-4:] == order
    assert abs(float(rows[-1][1])) < 0.06
    times = [float(row[0]) for row in rows]
    assert times == sorted(times)
    assert all(b - a <= 0.0101 for a, b in pairwise(times))
    host.cycle(0x00)
    simulated.close()
    assert "frames are back: stepped again" in path.read_text()
