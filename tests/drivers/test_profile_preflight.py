"""Preflight with real profiles: wrong manual settings are refused, with the place to correct them."""

from dataclasses import replace

import pytest

from drivers.canopen.quick_stop import CanopenTarget
from drivers.drive import Mode, Outcome
from drivers.own_limits import FLOAT_ROUNDING
from profiles.canopen import CanopenProfile
from profiles.entry import Require
from profiles.library import load_canopen_profile
from tests.drivers.drive_benches import CanopenBench, Run
from tests.drivers.profile_benches import AbbBench, Epos4Bench, S120Bench


@pytest.fixture
def make(open_bench):
    return open_bench


def found_with(bench, index=0, sub=0, value=None):
    if value is not None:
        store = bench.simulated.simulator.node.store
        store.live.pop(index << 8 | sub, None)
        store.values[index << 8 | sub] = value
    bench.drive.connect()
    return bench.drive.preflight(bench.limits)


def refused(found):
    return {check.name: check for check in found.refused}


@pytest.mark.parametrize("kind", [Epos4Bench, S120Bench])
def test_with_default_settings_it_is_accepted_and_every_limit_is_in_the_drive(make, kind):
    found = found_with(make(kind))
    assert found.refused == ()
    titles = [check.name for check in found.checks if check.outcome is Outcome.OK]
    assert {"torque limit", "speed limit", "unit of speed", "watchdog"} <= set(titles)
    ramp = next(check for check in found.checks if check.name == "quick-stop ramp")
    assert "wider, accepted by --accept-wider-limit quick-stop" in ramp.found


def test_a_drive_whose_mode_can_only_be_written(make):
    """CiA 402 permits 6060h as write-only; 6061h confirms each switch, also in motion."""
    bench = make(CanopenBench)
    bench.simulated.simulator.node.store.variable(0x6060, 0).access_type = "wo"
    run = Run(bench)
    run.turning(2.0, for_s=2.0)
    run.until(lambda sample: sample.mode is Mode.TORQUE, 1.0, Mode.TORQUE, torque=10.0)
    run.stop()
    assert run.drive.close() == ()


@pytest.mark.parametrize("unit", [0xFFB44700, 0xFDB44700, 0x00000000])
def test_another_unit_of_speed_is_refused(make, unit):
    check = refused(found_with(make(Epos4Bench), 0x60A9, 0, unit))["unit of speed"]
    assert (check.wanted, check.found, check.where) == ("00B44700h", f"{unit:08X}h", "60A9h")
    assert "60A9h" in check.next_step


def test_no_torque_constant_no_torque_limit(make):
    found = refused(found_with(make(Epos4Bench), 0x3001, 5, 0))
    assert set(found) == {"3001h:05 Torque constant", "torque limit"}
    assert "at least 1" in found["3001h:05 Torque constant"].wanted
    assert "reads 0" in found["torque limit"].found


def test_rated_torque_is_in_micro_newton_metres(make):
    bench = make(Epos4Bench)
    found = found_with(bench)
    assert bench.read(0x6076) == 1_000_000_000
    assert found.rated_torque_nm == pytest.approx(1000.0)


@pytest.mark.parametrize(("index", "sub", "value", "title", "words"), [
    (0x4228, 0, 1, "p8744 CAN PDO mapping configuration", "p8744 = 2"),
    (0x2803, 1, 0, "p2051[1] the second send word, r0080", "r0080[0]"),
    (0x2803, 1, 31 << 16, "p2051[1] the second send word, r0080", "r0080[0]"),       # the smoothed signal
    (0x2198, 0, 0, "unit of speed", "p8630[0]"),
    (0x21A2, 0, 200, "unit of speed", "scaled"),
])
def test_manual_settings_of_an_s120(make, index, sub, value, title, words):
    check = refused(found_with(make(S120Bench), index, sub, value))[title]
    assert words in check.next_step
    assert f"{index:04X}h" in check.where


def test_an_s120_with_another_encoder_is_scaled_by_it(make):
    """1024 pulses and 2^9 give 524288 counts per turn."""
    bench = make(S120Bench)
    store = bench.simulated.simulator.node.store
    store.values[0x21A200] = 9
    assert found_with(bench, 0x2198, 0, 1024).speed_resolution_rad_s == pytest.approx(6.283185307 / 524288)


def test_the_limits_of_an_s120_read_back_as_written(make):
    bench = make(S120Bench)
    found_with(bench)
    # IEEE 754: 300, -300 N·m; 143.2394 rpm is 15 rad/s; 15 s down from there at 1 rad/s²
    assert bench.read(0x6072) == 0x43960000
    assert bench.read(0x25F1) == 0xC3960000
    assert bench.read(0x243A) == 0x430F3D4D
    assert abs(bench.read(0x246F) - 0x41700000) <= 1       # calculated from a speed that is one of these


def test_a_missing_object_is_reported(make):
    bench = make(S120Bench)
    bench.simulated.simulator.node.store.remove(0x5810)
    check = refused(found_with(bench))["PDO mapping"]
    assert check.where == "1A00h:2"


class UnlimitedBench(CanopenBench):
    WORN = True

    def __init__(self):
        super().__init__()
        sections = self.drive._profile
        torque = sections.torque.model_copy(update={"max_torque_rated_per_lsb": None})
        self.drive._profile = sections.model_copy(update={"torque": torque})


def test_the_table_states_if_only_the_host_limits_the_torque(make):
    found = found_with(make(UnlimitedBench))
    note = next(check for check in found.checks if check.name == "torque limit")
    assert note.outcome is Outcome.NOTE
    assert "only the guard and the setpoint" in note.found


# -- torque of 32 bits: it shares TPDO1 with the speed, and the statusword comes in TPDO2 ------------------------------


def wide_profile(kind):
    from profiles.library import load_canopen_profile

    data = load_canopen_profile("siemens/s120-canopen").model_dump()
    data["torque"]["actual"] = {"index": 0x5830, "sub": 0, "type": kind, "per_lsb": 0.5, "unit": "nm"}
    return CanopenProfile.model_validate(data)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("kind", ["i32", "f32"])
def test_torque_of_32_bits(make, monkeypatch, kind):
    from tests.drivers import drive_benches

    monkeypatch.setattr(drive_benches, "load_canopen_profile", lambda name: wide_profile(kind))
    run = Run(make(S120Bench))
    found = run.ready()
    mapping = next(check for check in found.checks if check.name == "PDO mapping")
    assert mapping.wanted == "6040+60FF, 5830+606C, 6041+6061+6064"
    run.enable()
    last = run.go(12.0, speed=5.0)
    assert last.torque_nm == pytest.approx(100.0, abs=1.0)
    assert last.speed_rad_s == pytest.approx(5.0, abs=0.01)
    missed = run.drive.counters.missed                     # none, unless the computer paused for half a second
    assert missed <= 2
    # Half of the feedback of a cycle does not count: torque and state must be of one instant.
    run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x281 else [message]
    assert not run.cycle(speed=5.0).fresh
    run.bench.bus.change = lambda message: [] if message.arbitration_id == 0x181 else [message]
    assert not run.cycle(speed=5.0).fresh
    run.bench.bus.change = lambda message: [message]
    assert run.cycle(speed=5.0).fresh
    assert run.drive.counters.missed == missed + 2
    assert run.samples[-1].mode is Mode.SPEED


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("kind", [AbbBench, Epos4Bench, S120Bench])
def test_a_bare_stop_sees_the_speed_in_the_drives_own_scale(make, kind):
    """The S120 counts encoder increments. An ABB drive in velocity mode shows its speed in another object."""
    bench = make(kind)
    Run(bench).turning(5.0)
    target = CanopenTarget(bench._second, load_canopen_profile(kind.PROFILE), bench.drive.clock, node=1)
    seen = target.poll()
    assert seen.speed == pytest.approx(5.0, abs=0.2)
    assert not seen.near_zero


@pytest.mark.parametrize(("require", "value", "good"), [
    (Require(equals=2), 2.0, True), (Require(equals=2), 2.1, False), (Require(one_of=(1, 3)), 3.0, True),
    (Require(one_of=(1, 3)), 2.0, False), (Require(at_least=1), 0.0, False),
    (Require(at_least=1, at_most=2), 3.0, False), (Require(at_least=1, at_most=2), 1.5, True),
    (Require(equals=0.1), 0.10000000149011612, True),
])
def test_requirements(require, value, good):
    assert require.met_by(value, FLOAT_ROUNDING * abs(value)) is good
    assert require.text_in("s").endswith(" s")


@pytest.mark.parametrize("limit_nm", [123.4567, 300.0005, 7.77])
def test_a_torque_limit_in_counts_is_never_above_the_request(make, limit_nm):
    """The limit of an EPOS4 is 3001h:02 in mA times the torque constant 3001h:05 in µN·m/A, in coarse counts."""
    bench = make(Epos4Bench)
    bench.limits = replace(bench.limits, torque_nm=limit_nm)
    assert refused(found_with(bench)) == {}
    store = bench.simulated.simulator.node.store
    current, constant = (store.values[0x3001 << 8 | sub] for sub in (2, 5))
    count_nm = 1e-9 * constant
    assert current * count_nm <= limit_nm * (1.0 + 1e-9) and (current + 1) * count_nm > limit_nm
