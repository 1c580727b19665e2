"""Register bank of the simulated drive: functions, exceptions, types, scales, and effects of parameters."""

import struct
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from profiles.errors import TdhilError
from profiles.modbus import ModbusProfile
from sim_bus.modbus.codec import RegisterLayout
from sim_bus.params import DriveParams, ReportingParams, RigParams
from tests.rigs import QUIET_RIG
from tests.sim_bus.modbus_host import GENERIC, GenericHost, Host, Refusal, drive

FORMATS = {"u16": "H", "i16": "h", "u32": "I", "i32": "i"}
SOURCE = {"source": "for this test", "confidence": "verified"}


@given(st.sampled_from(sorted(FORMATS)).flatmap(lambda kind: st.tuples(
    st.just(kind), st.integers(RegisterLayout(0, kind).lowest, RegisterLayout(0, kind).highest))), st.booleans())
def test_every_number_of_every_type_is_stored_as_by_struct(case: tuple[str, int], high_first: bool) -> None:
    kind, number = case
    layout = RegisterLayout(7, kind, high_first=high_first)
    packed = struct.pack(">" + FORMATS[kind], number)
    words = struct.unpack(f">{len(packed) // 2}H", packed)
    assert layout.words(number) == (words if high_first else words[::-1])
    assert layout.number(layout.words(number)) == number
    assert list(layout.addresses) == list(range(7, 7 + len(words)))


@given(st.sampled_from(sorted(FORMATS)), st.floats(-1e13, 1e13))
def test_values_out_of_range_saturate(kind: str, value: float) -> None:
    layout = RegisterLayout(0, kind)
    number = layout.saturated(value)
    wanted = value if kind[0] == "i" else abs(value)
    assert layout.lowest <= number <= layout.highest
    struct.pack(">" + FORMATS[kind], number)
    if layout.lowest < wanted < layout.highest:
        assert abs(number - wanted) <= 0.5
    else:
        assert number in {layout.lowest, layout.highest}


@pytest.mark.parametrize(("pdu", "code"), [
    ("03 0010 0004", 0), ("03 0010 0000", 3), ("03 0010 007e", 3), ("03 0010", 3), ("03 0005 0001", 2),
    ("03 0013 0004", 2), ("04 0010 0001", 1), ("04 0000 0001", 1), ("08 0000 0000", 1), ("2b 0e0100", 1), ("41", 1),
    ("06 0001 0001", 0), ("06 0010 0001", 2), ("06 0005 0001", 2), ("06 0001", 3),
    ("10 0000 0002 04 0000 0000", 0), ("10 0000 0002 02 0000", 3), ("10 0000 0002 04 0000", 3),
    ("10 0000 0000 00", 3), ("10 000f 0002 04 0000 0000", 2), ("10 0020 0002 04 0000 0001", 2),
    ("17 0010 0004 0000 0001 02 0000", 0), ("17 0010 0004 0000 0001 02", 3), ("17 0010 007e 0000 0001 02 0000", 3),
    ("17 0005 0001 0000 0001 02 0000", 2), ("17 0010 0001 0005 0001 02 0000", 2), ("06 0004 0007", 3),
    ("10 fde8 0001 02 0000", 2),
])
def test_exceptions(pdu: str, code: int) -> None:
    assert Host(drive()).refused(bytes.fromhex(pdu.replace(" ", ""))) == code


@given(st.binary(max_size=260))
def test_any_request_gets_a_reply(pdu: bytes) -> None:
    reply, _ = SHARED.serve(1, pdu, SHARED.time_s)
    assert reply is not None
    code = pdu[0] if pdu else 0
    assert reply[0] == code or (reply[0] == code | 0x80 and reply[1] in {1, 2, 3, 4})


SHARED = drive()


def test_a_refused_write_changes_nothing() -> None:
    host = GenericHost(drive())
    host.write(1, (1, 2, 3))
    for pdu in ("10 0003 0003 06 0001 0001 0001", "10 0003 0002 04 0001 0007", "17 0005 0001 0003 0001 02 0001"):
        assert host.refused(bytes.fromhex(pdu.replace(" ", ""))) in {2, 3}
        assert host.read(0, 5) == (0, 1, 2, 3, 0)


def test_writing_half_of_a_number_keeps_the_other_half() -> None:
    host = GenericHost(drive())
    host.write(1, (0x1234, 0x5678))
    host.write_one(2, 0x9ABC)
    assert host.read(1, 2) == (0x1234, 0x9ABC)


def test_limits_of_length() -> None:
    profile = GENERIC.model_copy(update={"cycle": GENERIC.cycle.model_copy(
        update={"functions": (3, 16), "largest_read": 3, "largest_write": 2})})
    host = GenericHost(drive(profile))
    host.read(16, 3)
    host.write(1, (0, 0))
    for pdu, code in (("0300100004", 3), ("10000100030600000000 0000", 3), ("0600010000", 1), ("17", 1)):
        assert host.refused(bytes.fromhex(pdu)) == code


def test_registers_in_a_gap_can_be_read_but_not_written() -> None:
    profile = GENERIC.model_copy(update={"cycle": GENERIC.cycle.model_copy(update={"largest_gap": 11})})
    host = GenericHost(drive(profile))
    assert host.read(5, 11) == (0,) * 11
    assert host.refused(bytes.fromhex("0600050001")) == 2
    assert host.refused(bytes.fromhex("0300600001")) == 2                    # beyond the map


def test_marker_shows_simulated_and_stepped() -> None:
    words = Host(drive()).read(0xFDE8, 13)
    assert struct.pack(">12H", *words[:12]).rstrip(b"\0") == b"tdhil simulated drive" and words[12] == 1


def test_ratings_are_the_rigs_and_consistent() -> None:
    host = GenericHost(drive(params=RigParams()))
    assert host.number(32, "I") == 100_000                                     # 1000 N·m
    speed_rad_s = host.number(35, "H") * 0.1 * 2 * pi / 60
    assert host.number(34, "H") * 0.01 == pytest.approx(1000 * speed_rad_s / 1000, rel=0.005)
    assert (host.number(45, "H"), host.number(46, "H")) == (400, 150)          # ms: the rig's reporting lags
    assert host.number(42, "I") == 0x12345678 and host.number(44) == -12345 and host.number(41, "H") == 3


@pytest.mark.parametrize("torque_nm", [2.0, 60.0, 20_000.0])
def test_a_name_plate_fits_small_and_large_machines(torque_nm: float) -> None:
    rig = QUIET_RIG.model_copy(update={"drive": DriveParams(rated_torque_nm=torque_nm, torque_limit_nm=torque_nm)})
    host = GenericHost(drive(params=rig))
    watt = host.number(32, "I") * 0.01 * host.number(35, "H") * 0.1 * 2 * pi / 60
    assert host.number(34, "H") * 10 == pytest.approx(watt, rel=0.005)


def test_a_rig_beyond_the_range_of_the_registers_is_refused() -> None:
    rated = GENERIC.parameters[0].model_copy(update={"register_": GENERIC.parameters[0].register_.model_copy(
        update={"type": "u16"})})
    profile = GENERIC.model_copy(update={"parameters": (rated, *GENERIC.parameters[1:])})
    with pytest.raises(TdhilError, match=r"rated torque can't tell 1000: the nearest is 655\.35"):
        drive(profile)


def test_filter_registers_show_the_filters_of_the_drive() -> None:
    lags = ReportingParams(speed_lag_s=0.0123456, torque_lag_s=0.0)
    simulated = drive(params=RigParams(reporting=lags))
    worn = simulated.machine.inverter.params.reporting
    assert GenericHost(simulated).read(45, 2) == (12, 0)
    assert (worn.speed_lag_s, worn.torque_lag_s) == (0.012, 0.0)               # the rounded value is used
    assert (worn.speed_quantum_rpm, worn.torque_quantum_permille) == (0.0, 0.0)


def test_documented_filters_are_used() -> None:
    profile = changed({"filters": ({"signal": "torque", "documented_s": 0.0064, **SOURCE},)})
    worn = drive(profile, RigParams()).machine.inverter.params.reporting
    assert (worn.speed_lag_s, worn.torque_lag_s) == (0.40, 0.0064)


def test_a_cut_off_frequency_is_reported_as_such() -> None:
    data = GENERIC.model_dump(by_alias=True)
    data["parameters"][-2].update(unit="hz", per_lsb=0.001)
    simulated = drive(ModbusProfile.model_validate(data), RigParams())
    assert GenericHost(simulated).number(45, "H") == round(1000 / (2 * pi * 0.4))
    assert simulated.machine.inverter.params.reporting.speed_lag_s == pytest.approx(0.4, rel=0.01)


def test_limits_are_effective() -> None:
    simulated = drive()
    host = GenericHost(simulated)
    host.write_one(38, 150)                                                    # ‰
    host.write_one(36, 300)                                                    # 0.1 rpm
    limits = simulated.machine.inverter.control.limits
    assert limits.torque_forward_nm == limits.torque_reverse_nm == pytest.approx(150)
    assert limits.speed_rad_s == pytest.approx(pi)
    host.write_one(38, 65535)
    assert limits.torque_forward_nm == 400                                     # never beyond the rig's inverter
    host.write_one(39, 286)                                                    # 0.1 rpm/s
    assert simulated.machine.application.settings.quick_stop_rad_s2 == pytest.approx(28.6 * pi / 30)


def test_a_value_that_needs_a_restart_is_stored_without_effect() -> None:
    data = GENERIC.model_dump(by_alias=True)
    limit = next(one for one in data["parameters"] if one["name"] == "torque_limit")
    limit["writable_in_operation"] = False
    simulated = drive(ModbusProfile.model_validate(data))
    host = GenericHost(simulated)
    for value in (150, 120):
        host.write_one(38, value)
        assert host.read(38) == (value,)
        assert simulated.machine.inverter.control.limits.torque_forward_nm == 400


def test_a_quick_stop_time_counts_from_the_speed_that_it_names() -> None:
    data = GENERIC.model_dump(by_alias=True)
    others = [one for one in data["parameters"] if one["name"] != "quick_stop_deceleration"]
    data["parameters"] = (*others, {
        "name": "stop_time", "title": "from rated speed to rest", "register": {"address": 39, "type": "u16"},
        "per_lsb": 0.1, "unit": "s", "times": "rated_speed", "set_to": "quick_stop_time", **SOURCE})
    simulated = drive(ModbusProfile.model_validate(data))
    host, settings = GenericHost(simulated), simulated.machine.application.settings
    assert host.read(39) == (70,) and settings.quick_stop_rad_s2 == pytest.approx(3.0, rel=0.01)   # 200 rpm in 7.0 s
    host.write_one(39, 20)
    assert settings.quick_stop_rad_s2 == pytest.approx(200 * pi / 30 / 2.0)
    host.write_one(39, 0)
    assert settings.quick_stop_rad_s2 == float("inf")


@given(st.integers(-20_000, 20_000), st.integers(-2**31, 2**31 - 1))
def test_echoes_show_the_decoded_value(torque: int, speed: int) -> None:
    host = GenericHost(SHARED)
    host.now_s = SHARED.time_s
    host.write(1, struct.unpack(">3H", struct.pack(">ih", speed, torque)))
    clamped = max(-2**31, min(2**31 - 1, 10 * speed))
    assert host.number(48, "i") == clamped                                     # 0.001 rpm for 0.01 rpm
    assert host.number(50, "i") == 100 * torque                                # 0.01 N·m for ‰ of 1000 N·m


def changed(update: dict[str, object]) -> ModbusProfile:
    return ModbusProfile.model_validate(GENERIC.model_dump(by_alias=True) | update)


def test_scales_follow_the_parameter_that_multiplies() -> None:
    data = GENERIC.model_dump(by_alias=True)
    data["parameters"] = (*data["parameters"], {
        "name": "speed_scaling", "title": "speed for 20000", "register": {"address": 60, "type": "u16"},
        "per_lsb": 0.5, "unit": "rpm", "default": 100.0, "set_to": "speed_limit_reverse", **SOURCE})
    data["cycle"]["speed_setpoint"] |= {"register": {"address": 1, "type": "i16"}, "per_lsb": 1 / 20000,
                                        "times": "speed_scaling"}
    simulated = drive(ModbusProfile.model_validate(data))
    host = GenericHost(simulated)
    assert host.number(60, "H") == 200
    host.write_one(1, 10_000)
    assert simulated.machine.application.target_speed_rad_s == pytest.approx(50 * 2 * pi / 60)
    host.write_one(60, 400)
    host.write_one(1, 10_000)
    assert simulated.machine.application.target_speed_rad_s == pytest.approx(100 * 2 * pi / 60)


def test_word_order_and_input_table_of_the_line() -> None:
    data = GENERIC.model_dump(by_alias=True)
    data["line"] |= {"word_order": "low_first"}
    data["cycle"]["speed"]["register"] |= {"table": "input"}
    data["cycle"] |= {"functions": (3, 4, 16)}
    host = GenericHost(drive(ModbusProfile.model_validate(data)))
    assert host.read(42, 2) == (0x5678, 0x1234)
    assert host.read(17, 2, function=4) == (0, 0)
    with pytest.raises(Refusal, match="2"):
        host.read(17, 2)
