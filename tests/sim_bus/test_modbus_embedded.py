"""Embedded drive over its registers: motion, modes, stops, watchdog, repeatability."""

import struct
from itertools import pairwise
from math import pi
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from profiles.library import load_modbus_profile, load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams
from tests.rigs import QUIET_RIG
from tests.sim_bus.modbus_host import GENERIC, GenericHost, drive

RPM = 2 * pi / 60


def test_speed_control_and_quick_stop() -> None:
    simulated = drive()
    host = GenericHost(simulated)
    assert host.command(0x00)[0] & 0x4F == 0x40
    host.enable(20.0)
    status, speed, _ = host.cycles(8.0, rpm=20.0)
    assert speed == pytest.approx(20.0, abs=0.1) and status & 0x6F == 0x27
    assert simulated.speed_rad_s == pytest.approx(20 * RPM, abs=0.02)
    status, speed, _ = host.cycles(3.0, 0x02, rpm=20.0)
    assert status & 0x6F == 0x07 and speed == pytest.approx(0.0, abs=0.05)     # holds: the profile's quick_stop.ends
    assert host.command(0x00)[0] & 0x4F == 0x40
    assert abs(simulated.speed_rad_s) < 0.005


def test_the_switch_to_torque_control_is_bumpless() -> None:
    simulated = drive()
    host = GenericHost(simulated)
    host.enable(20.0)
    _, _, torque = host.cycles(8.0, rpm=20.0)
    host.command(0x0F, 20.0, torque)
    assert host.read(20) == (0,)
    host.write_one(4, 1)
    assert host.read(20) == (1,) and host.read(4) == (1,)
    status, speed, actual = host.cycles(1.0, rpm=20.0, torque=torque)
    assert speed == pytest.approx(20.0, abs=0.3) and actual == pytest.approx(torque, abs=0.002)
    host.cycles(0.5, torque=torque + 0.1)
    assert simulated.speed_rad_s > 20.5 * RPM
    status, speed, _ = host.cycles(3.0, 0x02, torque=torque)
    assert status & 0x6F == 0x07 and abs(speed) < 0.05
    host.write_one(4, 0)
    assert host.read(20) == (0,)


def test_reported_values_lag_and_count_in_registers() -> None:
    simulated = drive(params=QUIET_RIG.model_copy(update={"reporting": RigParams().reporting.model_copy(
        update={"speed_noise_rad_s": 0.0, "torque_noise_nm": 0.0})}))
    host = GenericHost(simulated)
    host.enable()
    host.cycles(0.1, rpm=20.0)
    host.write_one(4, 1)
    speeds, times = [], []
    for _ in range(100):
        host.wait(0.02)
        _, rpm, _ = host.command(0x0F, torque=0.3)
        speeds.append(rpm * RPM)
        times.append(simulated.speed_rad_s)
    late = [(true - told) for told, true in zip(speeds, times, strict=True)]
    acceleration = (times[-1] - times[-20]) / (19 * 0.0248)
    assert late[-1] == pytest.approx(0.4 * acceleration, rel=0.15)             # first-order lag of 0.4 s on a ramp


def watched(host: GenericHost, **options: float) -> None:
    host.write_one(40, 300)                                                     # ms
    host.enable(20.0)
    host.cycles(8.0, rpm=20.0)


def test_silence_stops_the_shaft(tmp_path: Path) -> None:
    path = tmp_path / "shaft.csv"
    with drive(trace=path) as simulated:
        host = GenericHost(simulated)
        host.wait(2.0)                                                           # not armed and no master: no reaction
        watched(host)
        began_s = host.now_s
        simulated.run_until(began_s + 0.29)
        assert simulated.speed_rad_s > 2.0
        simulated.run_until(began_s + 4.0)
        assert abs(simulated.speed_rad_s) < 0.005
        host.now_s = began_s + 4.0
        assert host.read(16)[0] & 0x00EF == 0x0087                               # quick stop active, warning
        assert host.command(0x0F, 20.0)[0] & 0x6F == 0x07                        # the old word does not reverse it
        host.command(0x00)
        host.enable(20.0)
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    events = [row[4] for row in rows if row[4]]
    at = events.index("host silent")
    assert events[0] == "power on" and events[at + 1] == "state: quick stop active" and "host is back" in events[at:]
    silent_s = next(float(row[0]) for row in rows if row[4] == "host silent")
    assert silent_s == pytest.approx(began_s + 0.3, abs=0.02)
    times = [float(row[0]) for row in rows]
    assert times == sorted(times) and all(b - a <= 0.0101 for a, b in pairwise(times))


def with_watchdog(**update: object) -> ModbusProfile:
    return GENERIC.model_copy(update={"watchdog": GENERIC.watchdog.model_copy(update=update)})


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("reaction", "state", "braking", "at_rest"), [
    ("quick_stop", 0x07, True, True), ("ramp_stop", 0x40, True, True), ("fault_reaction", 0x08, True, True),
    ("coast", 0x40, False, True), ("none", 0x27, False, False),
])
def test_reactions(reaction: str, state: int, braking: bool, at_rest: bool) -> None:
    simulated = drive(with_watchdog(reaction=reaction))
    host = GenericHost(simulated)
    watched(host)
    host.wait(0.7)
    torque_nm = simulated.machine.inverter.torque_nm
    assert simulated.speed_rad_s > 0.5 and (torque_nm < 0.0) is braking and (torque_nm == 0.0) is (reaction == "coast")
    host.wait(6.0)
    word = host.read(16)[0]
    assert word & (0x6F if state in {0x07, 0x27} else 0x4F) == state and word & 0x80
    assert (abs(simulated.speed_rad_s) < 0.01) is at_rest
    host.cycles(1.0, rpm=20.0)                                                   # the same command continues
    assert (abs(simulated.speed_rad_s) < 0.01) is at_rest


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("fed_by", "reads", "parameters", "commands"), [
    ("any_request", True, True, True), ("writes", False, True, True), ("control_word", False, False, True),
])
def test_what_feeds_the_watchdog(fed_by: str, reads: bool, parameters: bool, commands: bool) -> None:
    feeds = {
        "reads": (reads, struct.pack(">BHH", 3, 16, 1)), "parameters": (parameters, struct.pack(">BHH", 6, 38, 400)),
        "commands": (commands, struct.pack(">BHH", 6, 0, 15)),
    }
    for expected, pdu in feeds.values():
        simulated = drive(with_watchdog(fed_by=fed_by))
        host = GenericHost(simulated)
        watched(host)
        for _ in range(20):
            host.wait(0.1)
            host.ask(pdu)
        assert (simulated.speed_rad_s > 2.0) is expected


WORDS = st.sampled_from([0x00, 0x02, 0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x80, 0x10F])


@pytest.mark.heavy
@settings(max_examples=12, deadline=None)
@given(st.lists(st.tuples(WORDS, st.integers(-60, 60), st.integers(-300, 300), st.integers(0, 1)), max_size=25))
def test_after_any_commands_silence_stops_the_shaft(said: list[tuple[int, int, int, int]]) -> None:
    simulated = drive()
    host = GenericHost(simulated)
    host.write_one(40, 500)
    for word, rpm, per_mille, mode in said:
        host.write_one(4, mode)
        host.command(word, rpm, per_mille / 1000)
        host.wait(0.2)
    host.wait(25.0)
    assert abs(simulated.speed_rad_s) < 0.01
    assert host.read(16)[0] & 0x6F != 0x27                                       # the drive is no longer enabled


def test_a_reported_value_saturates_at_its_register() -> None:
    data = GENERIC.model_dump(by_alias=True)
    data["cycle"]["torque"] |= {"unit": "nm", "per_lsb": 0.01}
    host = GenericHost(drive(ModbusProfile.model_validate(data)))
    host.enable(0.0)
    host.cycles(0.6, rpm=60.0)                                                   # at the limit of 400 N·m
    assert host.number(19) == 32767
    host.cycles(0.6, rpm=-100.0)
    assert host.number(19) == -32768


def test_a_reaction_that_is_not_selected_has_no_effect() -> None:
    simulated = drive()
    host = GenericHost(simulated)
    host.write_one(41, 0)
    watched(host)
    host.wait(2.0)
    assert simulated.speed_rad_s > 2.0 and host.read(16)[0] & 0x80


def test_same_seed_same_bytes() -> None:
    def replies(seed: int) -> list[bytes]:
        host = GenericHost(drive(params=RigParams(), seed=seed))
        host.enable(25.0)
        return [host.ask(struct.pack(">BHH", 3, 16, 5)) for _ in range(300)]

    first = replies(7)
    assert first == replies(7) != replies(8)


def modbus_profiles() -> list[str]:
    return [name for name in profile_names() if isinstance(load_profile(name), ModbusProfile)]


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize("name", modbus_profiles())
def test_every_profile_turns_and_stops_the_simulated_drive(name: str) -> None:
    """The words of the profile enable the drive, the shaft follows, and the quick stop brings it to standstill."""
    profile = load_modbus_profile(name)
    with EmbeddedModbusDrive(QUIET_RIG, profile, unit=7) as simulated:
        machine = simulated.machine

        def send(address: int, *words: int) -> None:
            pdu = struct.pack(f">BHHB{len(words)}H", 16, address, len(words), 2 * len(words), *words) \
                if 16 in profile.cycle.functions else struct.pack(">BHH", 6, address, words[0])
            reply, _ = simulated.serve(7, pdu, simulated.time_s)
            assert reply is not None and reply[0] < 0x80

        def follow(duration_s: float, word: int | None = None) -> str:
            means = ""
            for _ in range(round(duration_s / 0.05)):
                simulated.run_until(simulated.time_s + 0.05)
                status = machine.words.status()
                state = next(one for one in profile.control.states if status & one.mask == one.value)
                means = state.means
                chosen = word if word is not None else state.onward
                assert chosen is not None
                send(profile.cycle.control.register_.address, chosen | profile.control.speed_bits)
            return means

        setpoint = profile.cycle.speed_setpoint
        counts = round(20.0 / machine.parameters.scale(setpoint.per_lsb, setpoint.unit, setpoint.times))
        send(setpoint.register_.address, *((counts,) if setpoint.register_.count == 1 else divmod(counts, 0x10000)))
        assert follow(10.0) == "enabled"
        assert simulated.speed_rad_s == pytest.approx(20 * RPM, rel=0.03)
        assert follow(8.0, profile.control.quick_stop) == profile.quick_stop.ends
        assert abs(simulated.speed_rad_s) < 0.005
        assert follow(0.5, profile.control.off) in {"off", "ready"}
