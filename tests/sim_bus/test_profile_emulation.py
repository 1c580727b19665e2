"""Simulated drive with a profile, checked by a host by hand: raw frames, no driver."""

import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import pytest

from profiles.canopen import CanopenProfile
from profiles.library import load_canopen_profile, profile_names, profile_path
from profiles.simulator_marker import MARKER_INDEX, MARKER_TEXT
from tests.path.path_runs import wait_for

Open = Callable[..., tuple[Any, Any]]
CANOPEN = [name for name in profile_names() if "bus: canopen" in profile_path(name).read_text(encoding="utf-8")]
S120 = "siemens/s120-canopen"


def guard(host: Any) -> bytes:
    host.bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
    return host.wait(0x701)


def map_pdo(host: Any, communication: int, mapping: int, cob: int, entries: tuple[int, ...]) -> None:
    """Disable, clear, map and enable a PDO at every SYNC (CiA 301)."""
    host.write(communication, 1, cob | 1 << 31, 4)
    host.write(mapping, 0, 0, 1)
    for number, entry in enumerate(entries, 1):
        host.write(mapping, number, entry, 4)
    host.write(mapping, 0, len(entries), 1)
    host.write(communication, 2, 1, 1)
    host.write(communication, 1, cob, 4)


def s120_in_motion(host: Any) -> None:
    """Turn at one turn per second with RPDO1 6040 + 60FF, TPDO1 6041 + 5810 + 606C at every SYNC of 10 ms."""
    for communication, mapping, cob, entries in (
        (0x1400, 0x1600, 0x201, (0x60400010, 0x60FF0020)),
        (0x1800, 0x1A00, 0x40000181, (0x60410010, 0x58100010, 0x606C0020)),
    ):
        map_pdo(host, communication, mapping, cob, entries)
    host.write(MARKER_INDEX, 3, 10_000, 4)
    host.nmt(1)
    for word in (0x06, 0x07, 0x0F):
        s120_cycle(host, word, 0)
    for number in range(1200):
        if number % 10 == 0:
            guard(host)
        s120_cycle(host, 0x0F, 4194304)


def s120_cycle(host: Any, word: int, velocity: int) -> tuple[int, int, int]:
    host.send(0x201, struct.pack("<Hi", word, velocity))
    host.send(0x080)
    return struct.unpack("<Hhi", host.wait(0x181))      # type: ignore[return-value]


@pytest.mark.parametrize("name", CANOPEN)
def test_identity_modes_and_marker(bench: Open, name: str) -> None:
    profile = load_canopen_profile(name)
    simulated, host = bench(profile=profile)
    wanted = profile.identity
    for sub, value in ((1, wanted.vendor), (2, wanted.product), (3, wanted.revision)):
        assert value is None or host.read(0x1018, sub) == value
    assert host.read(0x6502) == sum(1 << code - 1 for code in (*profile.modes.speed, *profile.modes.torque))
    for mode in (3, 4, 9, 10):
        allowed = mode in (*profile.modes.speed, *profile.modes.torque)
        assert (host.refused(0x6060, 0, mode, 1) == 0) is (allowed or host.read(0x6061) == mode)
    assert simulated.simulator.node.store.values[MARKER_INDEX << 8 | 1] == MARKER_TEXT


@pytest.mark.parametrize(("name", "absent"), [
    ("maxon/epos4", (0x1006, 0x6072, 0x6074, 0x6075, 0x6087, 0x60E0, 0x100C)),
    (S120, (0x1006, 0x1016, 0x605A, 0x6071, 0x6074, 0x6076, 0x6077, 0x6080, 0x6085, 0x60A9, 0x60C2)),
    ("generic/cia402", (0x100C, 0x100D, 0x5810)),
])
def test_absent_objects_are_absent(bench: Open, name: str, absent: tuple[int, ...]) -> None:
    _, host = bench(profile=load_canopen_profile(name))
    for index in absent:
        assert host.refused(index, 0, 0, 4) == 0x06020000, f"{index:04X}h"
        host.write(0x1800, 1, 0xC0000181, 4)
        host.write(0x1A00, 0, 0, 1)
        assert host.refused(0x1A00, 1, index << 16 | 16, 4) == 0x06020000


def test_without_a_profile_there_is_no_guarding_and_all_objects_exist(bench: Open) -> None:
    _, host = bench()
    host.bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
    assert host.read(0x6076) == 1_000_000
    assert not [data for can_id, data in host.heard if can_id == 0x701]


def test_replies_toggle_and_contain_the_state(bench: Open) -> None:
    _, host = bench(profile=load_canopen_profile(S120))
    assert [guard(host).hex() for _ in range(3)] == ["7f", "ff", "7f"]
    host.nmt(1)
    assert [guard(host).hex() for _ in range(2)] == ["85", "05"]
    host.nmt(2)
    assert guard(host) == b"\x84"
    host.nmt(130)
    assert host.wait(0x701) == b"\0"
    assert guard(host) == b"\x7f"                                          # the toggle restarts
    host.write(0x1017, 0, 100, 2)                                          # a heartbeat replaces guarding
    host.bus.send(can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False))
    host.read(0x1000)
    assert not [data for can_id, data in host.heard if can_id == 0x701]


@pytest.mark.heavy
@pytest.mark.parametrize(("reaction", "events"), [
    (3, ["host's node guarding lost", "state: quick stop active", "state: switch on disabled"]),
    (1, ["host's node guarding lost", "state: fault reaction active", "state: fault"]),
    (2, ["host's node guarding lost", "state: switch on disabled"]),
])
def test_a_silent_host_stops_the_shaft(bench: Open, tmp_path: Path, reaction: int, events: list[str]) -> None:
    """The trace of the true shaft shows it. The simulator continues in its own time after the last frame."""
    path = tmp_path / "trace.csv"
    simulated, host = bench(profile=load_canopen_profile(S120), trace=path)
    host.write(0x100C, 0, 50, 2)
    host.write(0x100D, 0, 4, 1)
    host.write(0x6007, 0, reaction, 2)
    s120_in_motion(host)
    assert simulated.simulator.speed_rad_s == pytest.approx(6.2831853, abs=0.05)
    begin_s = simulated.simulator.time_s
    simulated.simulator._time.silence_s = 0.05          # from here on; before, the host on a busy computer may be slow
    wait_for("the stop", lambda: abs(simulated.simulator.speed_rad_s) <= (0.05 if reaction != 2 else 5.9))
    wait_for("what comes of it", lambda: f",{events[-1]}\n" in path.read_text(encoding="utf-8"))
    simulated.close()
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()[1:]]
    seen = [(float(row[0]), row[4]) for row in rows if row[4] in events]
    assert [event for _, event in seen] == events
    assert seen[0][0] - begin_s == pytest.approx(0.2, abs=0.11)       # life time 50 ms x 4 after the last request
    if reaction != 2:
        assert abs(float(rows[-1][1])) < 0.05
        assert seen[-1][0] - seen[0][0] < 6.2832 / 3.0 + 1.5                # the quick-stop ramp of 3 rad/s²
    times = [float(row[0]) for row in rows]
    assert all(sooner <= later for sooner, later in pairwise(times))


@pytest.mark.heavy
@pytest.mark.parametrize(("guard_ms", "factor"), [(0, 4), (50, 0), (0, 0)])
def test_guarding_that_is_not_set_has_no_effect(bench: Open, guard_ms: int, factor: int) -> None:
    simulated, host = bench(profile=load_canopen_profile(S120))
    host.write(0x100C, 0, guard_ms, 2)
    host.write(0x100D, 0, factor, 1)
    s120_in_motion(host)
    for _ in range(200):
        s120_cycle(host, 0x0F, 4194304)
    assert simulated.simulator.speed_rad_s == pytest.approx(6.2831853, abs=0.05)


def test_settings_of_32_bit_floats(bench: Open) -> None:
    simulated, host = bench(profile=load_canopen_profile(S120))
    limits = simulated.simulator.node.application.inverter.control.limits
    host.write(0x6072, 0, 0x43160000, 4)                                     # 150.0
    host.write(0x25F1, 0, 0xC2C80000, 4)                                     # -100.0
    host.write(0x243A, 0, 0x42F00000, 4)                                     # 120.0 rpm
    host.write(0x246F, 0, 0x40C90FDB, 4)                                     # 2π s
    assert (limits.torque_forward_nm, limits.torque_reverse_nm) == (150.0, 100.0)
    assert limits.speed_rad_s == pytest.approx(4.0 * 3.14159265)
    assert simulated.simulator.node.application.settings.quick_stop_rad_s2 == pytest.approx(2.0, rel=1e-6)
    for value in (0x7FC00000, 0x7F800000, 0xFF800000):                       # NaN, the infinities
        assert host.refused(0x6072, 0, value, 4) == 0x06090030
    assert host.refused(0x6072, 0, 0, 2) == 0x06070010
    assert host.read(0x6072) == 0x43160000


def test_reset_restores_the_settings(bench: Open) -> None:
    simulated, host = bench(profile=load_canopen_profile(S120))
    host.write(0x6072, 0, 0x43160000, 4)
    host.nmt(129)
    assert host.wait(0x701) == b"\0"
    assert host.read(0x6072) == 0x43C80000                                   # 400.0, the machine's
    assert simulated.simulator.node.application.inverter.control.limits.torque_forward_nm == 400.0


def test_a_mode_that_cannot_be_mapped(bench: Open) -> None:
    _, host = bench(profile=load_canopen_profile(S120))
    host.write(0x1401, 1, 0x80000301, 4)
    host.write(0x1601, 0, 0, 1)
    assert host.refused(0x1601, 1, 0x60600008, 4) == 0x06040041


def test_another_reaction_object_and_filters(bench: Open) -> None:
    data = load_canopen_profile("generic/cia402").model_dump()
    data["watchdog"] |= {"reaction_index": 0x2345, "reaction_sub": 2, "reaction_value": 7, "reaction": "fault_reaction"}
    said = {"source": "a test", "confidence": "verified"}
    data["filters"] = (
        {"signal": "speed", "index": 0x2504, "type": "u16", "quantity": "time_constant_s", "per_lsb": 0.001} | said,
        {"signal": "torque", "index": 0x2505, "type": "f32", "quantity": "cutoff_hz"} | said,
    )
    from sim_bus.params import QUIET, ReportingParams, RigParams

    params = RigParams(noise=QUIET, reporting=ReportingParams(speed_lag_s=0.4, torque_lag_s=0.15))
    simulated, host = bench(params, profile=CanopenProfile.model_validate(data))
    assert host.read(0x2504) == 400
    assert struct.unpack("<f", host.read(0x2505).to_bytes(4, "little"))[0] == pytest.approx(1.0610, abs=1e-4)
    assert host.refused(0x6007, 0, 3, 2) == 0x06020000
    settings = simulated.simulator.node.application.settings
    for value, option in ((7, 1), (6, 0)):
        host.write(0x2345, 2, value, 2)
        assert settings.connection_option == option


def test_an_encoder_that_the_profile_does_not_know(bench: Open) -> None:
    """A profile from an EDS without values gets a default encoder, without a division by zero."""
    data = load_canopen_profile("elmo/gold").model_dump()
    data["parameters"] = tuple(one | {"default": None} for one in data["parameters"])
    simulated, host = bench(profile=CanopenProfile.model_validate(data))
    assert (host.read(0x608F, 1), host.read(0x608F, 2)) == (4096, 1)
    store, turned = simulated.simulator.node.store, simulated.simulator.node.application.inverter
    turned.state = turned.state._replace(angle_rad=2.5 * 6.283185307179586)
    assert store.live[0x606400]() == 2.5 * 4096             # and the angle uses its counts


@pytest.mark.heavy
def test_velocity_mode_follows_its_setpoint_only_where_it_is_released(bench: Open) -> None:
    """Velocity mode (CiA 402-2): bits 4 (ramp enabled), 5 (not locked) and 6 (reference used) of the controlword."""
    simulated, host = bench(profile=load_canopen_profile("abb/acs880-fcan"))
    for communication, mapping, cob, entries in (
        (0x1400, 0x1600, 0x201, (0x60400010, 0x60420010)),
        (0x1800, 0x1A00, 0x40000181, (0x60410010, 0x60770010, 0x60440010)),
    ):
        map_pdo(host, communication, mapping, cob, entries)
    host.write(MARKER_INDEX, 3, 10_000, 4)
    host.write(0x6060, 0, 2, 1)
    host.nmt(1)

    def cycle(word: int, rpm: int) -> tuple[int, int, int]:
        host.send(0x201, struct.pack("<Hh", word, rpm))
        host.send(0x080)
        return struct.unpack("<Hhh", host.wait(0x181))      # type: ignore[return-value]

    for word in (0x06, 0x07, 0x0F, 0x1F, 0x2F, 0x3F, 0x4F, 0x5F, 0x6F):
        for _ in range(60):
            cycle(word, 60)
        assert abs(simulated.simulator.speed_rad_s) < 0.01, f"{word:02X}h"
    for _ in range(1500):
        status, _, rpm = cycle(0x7F, 60)
    assert status & 0x6F == 0x27
    assert rpm == 60
    assert simulated.simulator.speed_rad_s == pytest.approx(6.2831853, abs=0.05)
    for _ in range(1500):
        cycle(0x3F, 60)                                     # the reference is no longer used
    assert abs(simulated.simulator.speed_rad_s) < 0.05
    assert host.refused(0x6060, 0, 3, 1) != 0
    assert host.refused(0x60FF, 0, 0, 4) == 0x06020000
