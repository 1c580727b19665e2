"""Golden exchanges, compared with both users of each profile: the codec of the driver, and the simulated drive."""

import math
from functools import cache

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Command, DriveLimits, Mode, PowerRequest
from drivers.modbus import pdu as requests
from drivers.modbus.access import RegisterAccess
from drivers.modbus.codec import find_scales, settle, si_per_count
from drivers.modbus.cycle import Codec, plan_cycle, shown_mode
from drivers.modbus.link import Reply
from drivers.modbus.parameters import Parameters, find_filters, wanted_setting
from drivers.modbus.state_machine import controlword_towards, decode, seen
from drivers.preflight import PreflightTable
from profiles.library import load_modbus_profile, load_profile, profile_names
from sim_bus.modbus.embedded import EmbeddedModbusDrive, LineTiming
from sim_bus.modbus.parameters import reporting_lag_s
from tests.profiles.golden import Exchange, Golden, Means, load, names, pdu
from tests.rigs import QUIET_RIG

NAMES = names()
CASES = [
    pytest.param(name, number, id=f"{name}-{number}-{exchange.does}")
    for name in NAMES
    for number, exchange in enumerate(load(name).exchanges)
]
CYCLES = [(name, number) for name in NAMES for number in range(len(load(name).cycles))]
MODES = {"speed": Mode.SPEED, "torque": Mode.TORQUE}
WISHES = {"off": PowerRequest.OFF, "enabled": PowerRequest.ENABLED, "quick_stop": PowerRequest.QUICK_STOP}


worn = cache(load_modbus_profile)      # strict YAML is slow to read


class Script:
    """Line that expects exactly these requests and returns these replies."""

    description = "script"

    def __init__(self, *expected: tuple[bytes, bytes]) -> None:
        self.clock = SteppedClock()
        self.left = list(expected)

    def transact(self, unit: int, request: bytes, timeout_s: float) -> Reply:
        wanted, reply = self.left.pop(0)
        assert request.hex(" ") == wanted.hex(" ")
        return Reply(reply, 0.0, 0.001)

    def close(self) -> None:
        pass


class Host:
    """Codec of the driver, with the stated values of the file."""

    def __init__(self, golden: Golden, *expected: tuple[bytes, bytes]) -> None:
        self.golden = golden
        self.profile = profile = worn(golden.profile)
        self.script = Script(*expected)
        self.access = RegisterAccess(
            self.script, profile.line.unit, profile.line.word_order, frozenset(profile.cycle.functions)
        )
        scales = find_scales(profile, golden.told, golden.rated_torque_nm)
        assert scales is not None, "the file does not contain every scale"
        self.plan = plan_cycle(profile)
        self.codec = Codec(profile, scales, has_demand=self.plan.has_demand)

    def word(self, means: Means) -> int:
        assert means.seen is not None and means.wish is not None and means.mode is not None
        control = self.profile.control
        return controlword_towards(
            control, decode(control, means.seen), WISHES[means.wish], MODES[means.mode], reverse=means.reverse
        )


def approximately(value: float) -> object:
    return pytest.approx(value, rel=2e-7, abs=1e-9)


def host_of(name: str, number: int) -> tuple[Host, Exchange]:
    golden = load(name)
    exchange = golden.exchanges[number]
    return Host(golden, (pdu(exchange.request), pdu(exchange.reply))), exchange


@pytest.mark.parametrize(("name", "number"), CASES)
def test_the_driver_encodes_and_decodes(name: str, number: int) -> None:
    host, exchange = host_of(name, number)
    means, profile, access = exchange.means, host.profile, host.access
    cycle, told = profile.cycle, host.golden.told
    if means.wish is not None:
        access.write(cycle.control.register_, host.word(means))
    elif means.write is not None:
        wanted = {"speed": (means.speed_rad_s, 0.0), "torque": (0.0, means.torque_nm)}[means.write]
        points = host.codec.setpoints(Command(MODES[means.write], *wanted))
        entry = {"speed": cycle.speed_setpoint, "torque": cycle.torque_setpoint}[means.write]
        access.write(entry.register_, {"speed": points.speed, "torque": points.torque}[means.write])
        assert points.reverse is means.reverse
    elif means.read is not None:
        entry = {"speed": cycle.speed, "torque": cycle.torque}[means.read]
        value = access.read(entry.register_) * getattr(host.codec.scales, means.read)
        assert value == approximately({"speed": means.speed_rad_s, "torque": means.torque_nm}[means.read])
    elif means.echo is not None:
        echo = next(one for one in profile.echoes if one.setpoint == means.echo)
        value = access.read(echo.register_) * si_per_count(echo, told, host.golden.rated_torque_nm)
        assert value == approximately({"speed": means.speed_rad_s, "torque": means.torque_nm}[means.echo])
    elif means.parameter is not None:
        counts = access.read(profile.parameter(means.parameter).register_)
        others = {key: value for key, value in told.items() if key != means.parameter}
        values = settle(profile, {means.parameter: counts}, others)
        assert values[means.parameter] == approximately(means.value)
    elif means.set is not None:
        parameter = profile.parameter(means.set)
        limits = DriveLimits(**host.golden.limits.model_dump())
        counts, lsb = wanted_setting(parameter, limits, host.golden.rated_torque_nm, told)
        assert counts * lsb == approximately(means.value)
        access.write(parameter.register_, counts)
    elif means.choose is not None:
        value = {"speed": profile.modes.speed_value, "torque": profile.modes.torque_value}[means.choose]
        access.write(profile.modes.register_, value)
    elif means.shows is not None:
        assert shown_mode(profile, access.read(profile.modes.display.register_)) is MODES[means.shows]
    else:
        status, control = access.read(cycle.status.register_), profile.control
        assert decode(control, status).means == means.state
        for bits in ("remote", "limit_active", "standstill"):
            told_bit = getattr(means, bits)
            assert told_bit is None or seen(getattr(control, bits), status) is told_bit, bits
    assert not host.script.left


@pytest.mark.parametrize(("name", "number"), CYCLES)
def test_the_driver_sends_whole_cycles(name: str, number: int) -> None:
    golden = load(name)
    cycle = golden.cycles[number]
    host = Host(golden, *((pdu(step.request), pdu(step.reply)) for step in cycle.steps))
    mode = MODES[cycle.mode]
    points = host.codec.setpoints(Command(mode, cycle.command.speed_rad_s, cycle.command.torque_nm))
    word = host.word(Means(wish=cycle.wish, seen=cycle.seen, mode=cycle.mode, reverse=points.reverse))
    image = host.codec.image(word, points, mode)
    words = {}
    for transaction in host.plan.cycle:
        request = transaction.request(image)
        reply = host.script.transact(1, request, 1.0).pdu
        span = transaction.read
        if span is not None:
            brought = requests.words_of(request, reply)
            words.update({(span.table, span.address + k): one for k, one in enumerate(brought)})
    assert not host.script.left
    found = host.codec.feedback(words)
    assert decode(host.profile.control, found.status).means == cycle.means.state
    assert found.speed_rad_s == approximately(cycle.means.speed_rad_s)
    assert found.torque_nm == approximately(cycle.means.torque_nm)
    if cycle.means.mode is not None:
        assert shown_mode(host.profile, found.mode_word) is MODES[cycle.means.mode]


@pytest.mark.parametrize("name", NAMES)
def test_filters(name: str) -> None:
    golden = load(name)
    host = Host(golden)
    found = find_filters(PreflightTable(), host.profile, Parameters({}, golden.told))
    assert {"speed": found.speed_lag_s, "torque": found.torque_lag_s} == {
        "speed": golden.filters_s.get("speed"), "torque": golden.filters_s.get("torque")
    }


@pytest.mark.parametrize("name", NAMES)
def test_the_simulated_drive_replies(name: str) -> None:
    golden = load(name)
    profile = worn(golden.profile)
    rig = QUIET_RIG
    rig = rig.model_copy(update={"drive": rig.drive.model_copy(update={"rated_torque_nm": golden.rated_torque_nm})})
    simulated = EmbeddedModbusDrive(rig, profile, unit=profile.line.unit, timing=LineTiming())
    parameters, reporting = simulated.machine.parameters, simulated.machine.inverter.reporting
    for key, value in golden.told.items():
        parameters.put(key, value)
    for signal, tau_s in golden.filters_s.items():
        assert math.isclose(reporting_lag_s(profile, parameters, signal), tau_s)
    application = simulated.machine.application
    for number, exchange in enumerate(golden.exchanges):
        means, request = exchange.means, pdu(exchange.request)
        if exchange.drive is None:
            continue
        if exchange.drive == "forced":
            reporting.speed_rad_s = means.speed_rad_s if means.speed_rad_s is not None else 0.0
            reporting.torque_nm = means.torque_nm if means.torque_nm is not None else 0.0
            reply = simulated.machine.request(request)
        else:
            reply, _ = simulated.serve(profile.line.unit, request, simulated.time_s + 0.005)
        assert reply is not None
        assert reply.hex(" ") == pdu(exchange.reply).hex(" "), f"{number}: {exchange.does}"
        if means.write == "speed":
            assert application.target_speed_rad_s == pytest.approx(means.speed_rad_s, rel=1e-3, abs=1e-9)
        elif means.write == "torque":
            assert application.target_torque_nm == pytest.approx(means.torque_nm, rel=1e-3, abs=1e-9)
        elif means.set is not None:
            assert parameters.value(means.set) == pytest.approx(means.value, rel=1e-9)
        elif means.choose is not None:
            register = profile.modes.register_
            value = {"speed": profile.modes.speed_value, "torque": profile.modes.torque_value}[means.choose]
            back, _ = simulated.serve(
                profile.line.unit, requests.read(3, register.address, 1), simulated.time_s + 0.005
            )
            assert back == bytes((3, 2)) + value.to_bytes(2, "big")
    simulated.close()


def test_every_profile_has_its_golden_exchanges() -> None:
    modbus = {name for name in profile_names() if load_profile(name).bus == "modbus"}
    assert {load(name).profile for name in NAMES} == modbus
    assert all(name == load(name).profile.replace("/", "_") for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_they_cover_the_entries_of_a_profile(name: str) -> None:
    golden = load(name)
    profile = worn(golden.profile)
    all_of = [exchange.means for exchange in golden.exchanges]
    statuses = [
        int(exchange.reply.split()[-1], 16) for exchange in golden.exchanges if exchange.means.state is not None
    ]
    control = profile.control
    assert len(statuses) >= 4
    assert all(decode(control, status) for status in statuses)
    assert {id(decode(control, status)) for status in statuses} == {id(state) for state in control.states}
    left = {id(decode(control, means.seen)) for means in all_of if means.wish == "enabled"}
    assert left >= {id(state) for state in control.states if state.onward is not None}
    assert {means.wish for means in all_of if means.wish} == {"off", "enabled", "quick_stop"}
    reads = [(means.read, (means.speed_rad_s or means.torque_nm or 0.0) < 0.0) for means in all_of if means.read]
    assert {("speed", True), ("torque", True)} <= set(reads)
    writes = {(means.write, (means.speed_rad_s or means.torque_nm or 0.0) < 0.0) for means in all_of if means.write}
    signed = profile.cycle.speed_setpoint.register_.type[0] == "i" or profile.control.reverse_bits is not None
    wanted = {("speed", False)} | ({("speed", True)} if signed else set())
    assert wanted | ({("torque", False), ("torque", True)} if profile.modes.torque else set()) <= writes
    echoes = {(means.echo, (means.speed_rad_s or means.torque_nm or 0.0) < 0.0) for means in all_of if means.echo}
    assert echoes == {
        (one.setpoint, below) for one in profile.echoes for below in (False, True)[: 1 + (one.register_.type[0] == "i")]
    }
    assert {means.set for means in all_of if means.set} == {one.name for one in profile.parameters if one.set_to}
    told = {one.name for one in profile.parameters if one.register_ is not None and one.set_to is None}
    assert {means.parameter for means in all_of if means.parameter} >= told
    if profile.modes.by == "register":
        assert {means.choose for means in all_of} >= {"speed", "torque"}
    if profile.modes.display is not None:
        assert {means.shows for means in all_of} >= {"speed", "torque"}
    if profile.modes.by == "control_bits":
        assert "torque" in {means.mode for means in all_of if means.wish}
    assert set(golden.filters_s) == {one.signal for one in profile.filters}
