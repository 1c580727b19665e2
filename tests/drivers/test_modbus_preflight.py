"""Preflight on a test bank: the marker, the whole table for a right drive, and each error of a register map."""

import dataclasses
import itertools
import json

import pytest

from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import Command, DriveLimits, Mode, Outcome
from drivers.errors import CommunicationLost, PreflightRefused
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from drivers.modbus.preflight import ECHO_POLL_S, ECHO_POLLS
from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile
from tests.drivers.modbus_bank import CONTROL, SPEED_SETPOINT, STATUS, TIME_OUT, Bank
from tests.drivers.power_machine import OFF, STOPPING

LIMITS = DriveLimits(speed_rad_s=15.0, torque_nm=300.0, quick_stop_rad_s2=1.0, watchdog_s=0.5)


@pytest.fixture(scope="module")
def generic():
    return load_modbus_profile("generic/modbus")


@pytest.fixture
def bank():
    return Bank()


def of(data):
    """Return the profile as read from a file: strict, with tuples for arrays."""
    return ModbusProfile.model_validate_json(json.dumps(data))


def changed(profile, **parts):
    """Return the profile with other parameters or other sections, by name."""
    data = profile.model_dump(by_alias=True)
    for name, change in parts.items():
        if name in data and not isinstance(data[name], str):
            data[name] = change if not isinstance(change, dict) else data[name] | change
        else:
            entry = next(one for one in data["parameters"] if one["name"] == name)
            entry |= change
    return of(data)


def drive_on(bank, profile, clock=None, **options):
    return ModbusDrive(EmbeddedLink(bank.serve, clock or SteppedClock()), profile, unit=1, **options)


def refused(bank, profile, limits=LIMITS, **options):
    """Return the refused rows of preflight by name, and assert that nothing moved."""
    drive = drive_on(bank, profile, **options)
    drive.connect()
    found = drive.preflight(limits)
    controlwords = [words[0] for address, words in bank.writes if address == CONTROL]
    assert set(controlwords) <= {0}
    assert all(check.where and check.next_step for check in found.refused)
    return {check.name: check for check in found.refused}


def test_a_right_drive(bank, generic):
    before = dict(bank.words)
    drive = drive_on(bank, generic)
    identity = drive.connect()
    assert identity.simulated
    assert bank.writes == []
    found = drive.preflight(LIMITS)
    assert found.refused == ()
    assert all(check.where for check in found.checks)
    assert found.modes == frozenset(Mode)
    assert (found.rated_torque_nm, found.torque_resolution_nm) == (800.0, 0.8)
    assert (found.filters.speed_lag_s, found.filters.torque_lag_s) == (0.040, 0.015)
    # 15 rad/s = 143.24 rpm, rounded up; 300 N·m of 800; 1 rad/s² = 9.55 rpm/s; 0.5 s
    assert [bank.words[at] for at in (36, 37, 38, 39, 40)] == [1433, 0x10000 - 1433, 375, 96, 500]
    assert [bank.words[at] for at in range(4)] == [0, 0, 0, 0]
    assert drive.close() == ()
    bank.show()
    # The status word shows that the drive never left 'switch on disabled'.
    assert {at: word for at, word in bank.words.items() if at != STATUS} == {
        at: word for at, word in before.items() if at != STATUS
    }


def test_a_drive_without_marker_is_real_and_never_stepped(generic):
    bank = Bank(marker=False)
    with pytest.raises(PreflightRefused, match="marker"):
        drive_on(bank, generic).connect()
    assert not drive_on(bank, generic, MonotonicClock()).connect().simulated
    assert bank.writes == []


def test_a_simulated_peer_in_its_own_time_is_not_stepped(bank, generic):
    bank.words[0xFDE8 + 12] = 0
    with pytest.raises(PreflightRefused, match="its own time"):
        drive_on(bank, generic).connect()


def test_silence(bank, generic):
    bank.silent = True
    with pytest.raises(PreflightRefused, match="no drive answers") as caught:
        drive_on(bank, generic).connect()
    assert "--unit" in caught.value.next_step


def test_a_drive_that_is_already_enabled(bank, generic):
    bank.machine.state = "operation enabled"
    with pytest.raises(PreflightRefused, match="another master"):
        drive_on(bank, generic).connect()
    assert bank.writes == []


def test_a_fault_is_never_reset_silently(bank, generic):
    bank.machine.state = "fault"
    rows = refused(bank, generic)
    assert "--reset-fault" in rows["state"].next_step
    assert bank.writes == []
    drive = drive_on(bank, generic)
    drive.connect()
    drive.reset_fault()
    assert [words for _, words in bank.writes] == [[0x0000], [0x0080], [0x0000]]
    assert drive.preflight(LIMITS).refused == ()


@pytest.mark.parametrize("state", [STOPPING, OFF])
def test_a_drive_that_is_not_in_fault_is_not_reset(bank, generic, state):
    bank.machine.state = state
    drive = drive_on(bank, generic)
    drive.connect()
    drive.reset_fault()
    assert bank.writes == []
    assert bank.machine.state == state


@pytest.mark.parametrize(("string", "torque", "let_go"), [
    (True, 250, False), (True, -250, False), (True, 4, True), (False, 250, True),
])
def test_a_string_that_is_held_wound_up_is_not_let_go_by_the_next_run(bank, generic, string, torque, let_go):
    bank.machine.state = STOPPING
    bank.feedback = lambda: (0, torque)
    rows = refused(bank, generic, dataclasses.replace(LIMITS, string=string))
    assert ("torque held in quick stop" in rows) is not let_go
    if not let_go:
        assert bank.writes == []
        assert bank.machine.state == STOPPING


def test_a_torque_limit_below_one_count_is_no_wider_one(bank, generic):
    rows = refused(bank, changed(generic, torque_limit={"per_lsb": 0.5}))
    assert "less than one count" in next(row.found for row in rows.values() if "highest torque" in row.name)


def test_a_turning_shaft_and_local_control(bank, generic):
    bank.feedback = lambda: (2000, 0)
    bank.remote = False
    rows = refused(bank, generic)
    assert set(rows) == {"state", "control over the field bus"}
    assert "2.09 rad/s" in rows["state"].found
    assert bank.writes == []


@pytest.mark.parametrize("first", range(3))
def test_one_reading_of_noise_is_no_turning_shaft(bank, generic, first):
    """Each third reading is 0.105 rad/s. One of the three cases begins with it."""
    readings = itertools.cycle([100, 5, -5][first:] + [100, 5, -5][:first])
    bank.feedback = lambda: (next(readings), 0)
    assert "state" not in refused(bank, generic)
    bank.feedback = lambda: (100, 0)
    assert "0.105 rad/s" in refused(bank, generic)["state"].found


def test_a_slow_run_accepts_the_noise_of_the_rig(bank, generic):
    """With --highest-speed the limit of the run is lower, and the signal at standstill is the same."""
    bank.feedback = lambda: (40, 0)         # 0.042 rad/s: 0.4 % of the rig's limit of 10 rad/s
    slow = dataclasses.replace(LIMITS, speed_rad_s=3.0)
    assert "state" in refused(bank, generic, slow)
    assert "state" not in refused(bank, generic, dataclasses.replace(slow, noise_scale_rad_s=10.0))


def test_a_fault_reaction_is_refused(bank, generic):
    bank.on_show = lambda words: words.update({STATUS: 0x021F})
    row = refused(bank, generic)["state"]
    assert row.found == "fault reaction, status 021Fh" and "--reset-fault" in row.next_step
    assert bank.writes == []


def test_three_coarse_counts_are_no_standstill(bank, generic):
    """A count is 1 rpm. 3 rpm is 0.31 rad/s, and standstill is at most 0.2 rad/s."""
    bank.feedback = lambda: (3, 0)
    plain = generic.model_dump(by_alias=True)
    plain["cycle"]["speed"] |= {"per_lsb": 1.0}
    assert "0.314 rad/s" in refused(bank, of(plain))["state"].found


# -- errors of a whole map: in the profile for a right drive, or in the drive ----------


def every_register(profile, change):
    """Return the profile with ``change(entry)`` in each register and in each entry with a scale."""
    def walk(part):
        if isinstance(part, dict):
            change(part)
            for one in part.values():
                walk(one)
        elif isinstance(part, list | tuple):
            for one in part:
                walk(one)

    data = profile.model_dump(by_alias=True, mode="json")
    walk(data)
    return of(data)


def swap_sign(part):
    if part.get("type", "")[1:] in ("16", "32") and "address" in part:
        part["type"] = {"i": "u", "u": "i"}[part["type"][0]] + part["type"][1:]


def scale(factor):
    def change(part):
        if "per_lsb" in part:
            part["per_lsb"] *= factor
    return change


def shift(by):
    def change(part):
        if "address" in part:
            part["address"] = max(0, part["address"] + by)
    return change


@pytest.mark.parametrize(("title", "wrong"), [
    ("word order", lambda profile: changed(profile, line={"word_order": "low_first"})),
    ("ten times", lambda profile: every_register(profile, scale(10.0))),
    ("a tenth", lambda profile: every_register(profile, scale(0.1))),
    ("one too high", lambda profile: every_register(profile, shift(1))),
    ("one too low", lambda profile: every_register(profile, shift(-1))),
    ("sign", lambda profile: every_register(profile, swap_sign)),
])
def test_an_error_in_the_whole_map_is_found_before_any_write(bank, generic, title, wrong):
    profile = wrong(generic)
    rows = refused(bank, profile)
    assert rows, title
    assert bank.writes == []


@pytest.mark.parametrize("name", ["rated_torque", "rated_power", "rated_speed", "check_pattern", "check_sign"])
@pytest.mark.parametrize("wrong", [{"per_lsb": 10.0}, {"address": 1}, {"address": -1}])
def test_one_known_register_that_is_wrong(bank, generic, name, wrong):
    entry = generic.parameter(name)
    address = entry.register_.address + wrong.get("address", 0)
    change = {"register": {**entry.register_.model_dump(), "address": address},
              "per_lsb": entry.per_lsb * wrong.get("per_lsb", 1.0)}
    assert refused(bank, changed(generic, **{name: change}))
    assert bank.writes == []


@pytest.mark.parametrize("setpoint", ["speed_setpoint", "torque_setpoint"])
@pytest.mark.parametrize("wrong", ["times 10", "one off", "16 bit"])
def test_one_setpoint_that_is_wrong(bank, generic, setpoint, wrong):
    """All known registers are right: only the echo of the drive shows the error."""
    data = generic.model_dump(by_alias=True)
    entry = data["cycle"][setpoint]
    if wrong == "times 10":
        entry["per_lsb"] *= 10.0
    elif wrong == "one off":
        # The registers 5 to 9 accept any value and have no function.
        entry["register"]["address"] = 6
    elif setpoint == "torque_setpoint":
        entry["register"]["address"] = 2
    else:
        entry["register"]["type"] = "i16"
    name = setpoint.split("_")[0]
    assert f"{name} setpoint as received by the drive" in refused(bank, of(data))


def test_setpoint_with_its_halves_swapped(bank, generic):
    """The drive has the opposite word order for 32-bit setpoints only."""
    def swap(address, words):
        if address == SPEED_SETPOINT:
            bank.words[1], bank.words[2] = words[1], words[0]

    bank.on_write = swap
    assert "speed setpoint as received by the drive" in refused(bank, generic)


@pytest.mark.parametrize("address", [1, 3, 4, 36, 37, 38, 39, 40])
def test_a_write_that_is_taken_but_not_applied(bank, generic, address):
    """Function 16 writes both registers of a setpoint together, and the drive ignores both."""
    bank.deaf_to = {address, 2} if address == 1 else {address}
    rows = refused(bank, generic)
    assert rows
    assert any(str(address) in check.where for check in rows.values())


@pytest.mark.parametrize("address", [0, 1, 36, 40, 41, 45])
@pytest.mark.parametrize("code", [1, 2, 3, 4])
def test_a_register_that_the_drive_refuses(bank, generic, address, code):
    bank.refuse_at = {address: code}
    rows = refused(bank, generic)
    if address == 45:
        assert rows == {}           # an unknown filter gives a note
    else:
        assert any(f"exception {code}" in check.found for check in rows.values())


def test_a_busy_drive_is_asked_again_for_a_bounded_time(bank, generic):
    bank.script = [lambda reply: bytes((reply[0] | 0x80, 6))] * 3
    drive = drive_on(bank, generic)
    drive.connect()
    assert drive.preflight(LIMITS).refused == ()
    bank.refuse = {3: 6}
    before = len(bank.requests)
    with pytest.raises(PreflightRefused, match="busy"):
        drive_on(bank, generic).connect()
    assert len(bank.requests) - before == 5


def test_the_checklist(bank, generic):
    """Settings that must be made by hand: all wrong ones are listed, each with title, register and advice."""
    bank.words[41] = 1
    bank.words[44] = 7
    profile = changed(generic, time_out_reaction={"advice": "Set 41 to 3 at the drive"})
    rows = refused(bank, profile)
    assert set(rows) == {"reaction to the time-out, 3 = quick stop", "register that reads -12345"}
    assert rows["reaction to the time-out, 3 = quick stop"].next_step == "Set 41 to 3 at the drive"
    assert bank.writes == []
    bank.words |= {41: 3, 44: 0x10000 - 12345}
    assert refused(bank, profile) == {}


def test_values_that_the_drive_does_not_report_must_be_stated(bank, generic):
    profile = changed(generic, rated_speed={"register": None}, rated_torque={"register": None})
    rows = refused(bank, profile)
    assert {"rated torque", "rated speed"} <= set(rows)
    assert "drive_data.parameters.rated_speed" in rows["rated speed"].next_step
    assert refused(bank, profile, given={"rated_speed": 200.0, "rated_torque": 800.0}) == {}
    assert "name plate: torque × speed" in refused(bank, profile, given={"rated_speed": 2000.0, "rated_torque": 800.0})


def test_rig_and_drive_must_agree_on_the_rated_torque(bank, generic):
    assert set(refused(bank, generic, rated_torque_nm=900.0)) == {"rated torque"}
    assert refused(bank, generic, rated_torque_nm=800.0) == {}


def test_scales_that_depend_on_parameters(generic):
    """The value is raw x per_lsb x another parameter: 16384 counts are the reference speed."""
    data = generic.model_dump(by_alias=True)
    data["cycle"]["speed_setpoint"] |= {"per_lsb": 0.01 / 200.0, "times": "rated_speed"}
    data["cycle"]["speed"] |= {"per_lsb": 0.01 / 200.0, "times": "rated_speed"}
    profile = of(data)
    bank = Bank()
    assert refused(bank, profile) == {}
    # With another reference in the drive, neither the echo nor the name plate agrees.
    bank.words[35] = 2100
    assert refused(bank, changed(profile, name_plate=None))


@pytest.mark.parametrize(("watchdog", "words", "wrong"), [
    ({"kind": "none", "parameter": None, "reaction": "none", "reaction_parameter": None}, {}, "watchdog"),
    ({"parameter": None}, {}, "watchdog"),
])
def test_a_watchdog_that_is_not_there(bank, generic, watchdog, words, wrong):
    bank.words |= words
    assert set(refused(bank, changed(generic, watchdog=watchdog))) == {wrong}


@pytest.mark.parametrize(("counts", "good"), [(0, False), (40, False), (300, True), (500, True), (501, False)])
def test_a_watchdog_that_is_set_by_hand(bank, generic, counts, good):
    """It is at most that of rig.yaml, and at least five cycles of 10 ms."""
    bank.words[TIME_OUT] = counts
    profile = changed(generic, time_out={"set_to": None})
    assert set(refused(bank, profile)) == (set() if good else {"watchdog"})


def test_a_coasting_reaction_is_reported(bank, generic):
    drive = drive_on(bank, changed(generic, watchdog={"reaction": "coast"}))
    drive.connect()
    found = drive.preflight(LIMITS)
    assert found.safe_action == "coast"
    assert any(check.name == "watchdog reaction" and check.found == "coast" for check in found.checks)


def test_the_rate_is_limited_by_the_line(generic):
    for takes_s, period_s in ((0.001, 0.010), (0.0098, 0.010), (0.0099, 0.01089), (0.020, 0.022)):
        drive = drive_on(Bank(takes_s=takes_s), generic)
        drive.connect()
        found = drive.preflight(LIMITS)
        assert drive.period_s == pytest.approx(period_s, abs=1e-5)
        row = next(check for check in found.checks if check.name == "cycle rate")
        assert row.outcome is (Outcome.NOTE if period_s > 0.010 else Outcome.OK)
        assert f"{1.0 / drive.period_s:.4g} Hz" in row.found


def test_a_line_too_slow_for_the_watchdog(generic):
    rows = refused(Bank(takes_s=0.1), generic)
    assert set(rows) == {"watchdog time"}
    assert "0.55 s" in rows["watchdog time"].next_step


def test_quick_stop_as_a_time(bank, generic):
    """1 rad/s² from 3000 rpm (314.16 rad/s) takes 314.1 s, in counts of 0.1 s, rounded down."""
    profile = changed(generic, quick_stop_deceleration={"set_to": "quick_stop_time", "unit": "s", "times": "top"},
                      rated_speed={"name": "top"}, name_plate=None)
    bank.words[35] = 30000
    assert refused(bank, profile, dataclasses.replace(LIMITS, accept_wider=frozenset({"quick-stop"}))) == {}
    assert bank.words[39] == 3141


@pytest.mark.parametrize("cut", ["hz", "fixed"])
def test_filters(bank, generic, cut):
    data = generic.model_dump(by_alias=True)
    whence = {"source": "made up for a test", "confidence": "verified"}
    if cut == "hz":
        next(one for one in data["parameters"] if one["name"] == "speed_filter").update(unit="hz", per_lsb=0.1)
        wanted = 0.0397887      # 1 / (2π 4 Hz)
    else:
        data["filters"] = [{"signal": "speed", "documented_s": 0.1, "advice": "take 63", **whence}]
        wanted = 0.1
    drive = drive_on(bank, of(data))
    drive.connect()
    found = drive.preflight(LIMITS)
    assert found.filters.speed_lag_s == pytest.approx(wanted, rel=1e-5)
    assert found.filters.source
    assert any(check.name == "speed filter" for check in found.checks)


def test_a_speed_only_drive(bank, generic):
    data = generic.model_dump(by_alias=True)
    data["cycle"]["torque_setpoint"] = None
    data["echoes"] = [one for one in data["echoes"] if one["setpoint"] == "speed"]
    data["modes"] |= {"torque": False, "by": "none", "register": None, "speed_value": None, "torque_value": None,
                      "display": None}
    drive = drive_on(bank, of(data))
    drive.connect()
    found = drive.preflight(LIMITS)
    assert found.refused == ()
    assert found.modes == {Mode.SPEED}
    assert all(address + len(words) <= 3 or address > 4 for address, words in bank.writes)
    with pytest.raises(PreflightRefused, match="torque"):
        drive.enable(Mode.TORQUE)


@pytest.mark.parametrize("late", [3, 1000])
def test_an_echo_may_be_late_but_not_stay_away(bank, generic, late):
    """Some drives update their display late. A drive that never shows the value is refused in bounded time."""
    clock = SteppedClock()
    shown, since = (0, 0), 0

    def show_late(words):
        nonlocal shown, since
        since += 1
        if since > late:
            shown, since = (words[48], words[49]), 0
        words[48], words[49] = shown

    bank.on_show = show_late
    drive = drive_on(bank, generic, clock)
    drive.connect()
    found = drive.preflight(LIMITS).refused
    assert [check.name for check in found] == ["speed setpoint as received by the drive"] * (late == 1000)
    assert all("Check that this bus is its reference source" in check.next_step for check in found)
    assert late == 3 or clock.now_s() > (ECHO_POLLS - 1.5) * ECHO_POLL_S   # the drive had enough time
    assert clock.now_s() < 5.0
    assert bank.words[SPEED_SETPOINT] == bank.words[SPEED_SETPOINT + 1] == 0


def test_a_setpoint_that_cannot_be_read_back_is_reported_as_untested(bank, generic):
    answer = bank.answer
    bank.answer = lambda pdu: (
        bytes((0x83, 2)) if pdu[0] == 3 and int.from_bytes(pdu[1:3], "big") == SPEED_SETPOINT else answer(pdu))
    drive = drive_on(bank, changed(generic, echoes=()))
    drive.connect()
    found = drive.preflight(LIMITS)
    assert found.refused == ()
    assert any(check.outcome is Outcome.NOTE and "can't be read: " in check.found for check in found.checks)


def test_rig_and_drive_must_agree_on_every_parameter_that_the_rig_states(bank, generic):
    rows = refused(bank, generic, given={"rated_speed": 1500.0})
    assert next(iter(rows.values())).next_step.startswith("rig.yaml and the drive state different values")


def test_a_ramp_up_is_as_steep_as_the_quick_stop_and_no_steeper(bank, generic):
    """1 rad/s² up to 3000 rpm takes 314.16 s, in counts of 0.1 s, rounded up. It is restored afterwards."""
    profile = changed(generic, quick_stop_deceleration={"set_to": "ramp_up_time", "unit": "s", "times": "top"},
                      rated_speed={"name": "top"}, name_plate=None)
    bank.words |= {35: 30000, 39: 30}
    drive = drive_on(bank, profile)
    drive.connect()
    assert drive.preflight(LIMITS).refused == ()
    assert bank.words[39] == 3142
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    drive.close()
    assert bank.words[39] == 30


# -- the drive's own limits ------------------------------------------------------------------------------------

TIGHT = {36: 400, 37: 0x10000 - 400, 38: 100, 39: 500}
"""40 rpm both ways, 80 N·m, 50 rpm/s: tighter than 15 rad/s, 300 N·m and 1 rad/s² everywhere."""
OF_LIMIT = {"speed": {36, 37}, "torque": {38}, "quick-stop": {39}}


class QuickClock(SteppedClock):
    """Clock for a drive that tdhil treats as a real one, without waits."""

    stepped = False


def real(words, **limits):
    """Return the preflight and the bank of a drive without the simulator's marker."""
    bank = Bank(marker=False)
    bank.words |= words
    drive = drive_on(bank, load_modbus_profile("generic/modbus"), clock=QuickClock())
    drive.connect()
    return drive.preflight(dataclasses.replace(LIMITS, **limits)), bank, drive


def test_limits_that_are_tighter_stay_and_the_run_keeps_within_them():
    found, bank, _ = real(TIGHT)
    assert not found.refused
    assert {at: bank.words[at] for at in TIGHT} == TIGHT
    assert found.kept_torque_nm == pytest.approx(80.0)
    assert found.kept_speed_rad_s == pytest.approx(40.0 * 0.10471975512)
    rows = [check for check in found.checks if "kept: tighter than rig.yaml's" in check.found]
    assert len(rows) == 4 and all("--accept-wider-limit" in row.next_step for row in rows)


@pytest.mark.parametrize("limit", sorted(OF_LIMIT))
def test_a_limit_is_widened_by_name_no_other_with_it_and_given_back(limit):
    found, bank, drive = real(TIGHT, accept_wider=frozenset({limit}))
    assert {at for at in TIGHT if bank.words[at] != TIGHT[at]} == OF_LIMIT[limit]
    rows = [check for check in found.checks if f"wider, accepted by --accept-wider-limit {limit}" in check.found]
    assert len(rows) == len(OF_LIMIT[limit]) and all("was " in row.found for row in rows)
    drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert drive.close() == ()
    assert {at: bank.words[at] for at in TIGHT} == TIGHT


def test_wider_limits_are_tightened_without_a_request_and_both_values_are_reported():
    found, bank, _ = real({39: 1})
    rows = {check.name: check for check in found.checks}
    assert rows["highest torque"].found == "0.375 of rated torque (was 2 of rated torque)"
    assert rows["deceleration of a quick stop"].found == "9.6 rpm/s (was 0.1 rpm/s)"
    assert found.kept_torque_nm is None and bank.words[38] == 375


def test_a_quick_stop_given_as_a_time_is_wider_if_it_is_longer():
    for counts, kept in ((100, True), (60000, False)):
        profile = changed(load_modbus_profile("generic/modbus"), quick_stop_deceleration={
            "set_to": "quick_stop_time", "unit": "s", "per_lsb": 0.001})
        bank = Bank(marker=False)
        bank.words[39] = counts
        drive = drive_on(bank, profile, clock=QuickClock())
        drive.connect()
        assert not drive.preflight(LIMITS).refused
        assert (bank.words[39] == counts) is kept, bank.words[39]


def test_a_simulated_drive_keeps_its_limits_alike():
    bank = Bank()
    bank.words |= TIGHT
    drive = drive_on(bank, load_modbus_profile("generic/modbus"))
    drive.connect()
    assert not drive.preflight(LIMITS).refused
    assert bank.words[38] == TIGHT[38] != 375


# -- further requirements ---------------------------------------------------------------------------------


def test_a_watchdog_that_falls_back_to_zero_is_not_armed(bank, generic):
    """It reads back as written, and then as 0, which is off. The later value is stable, but not armed."""
    answer, reads = bank.answer, []

    def forgets(pdu):
        if pdu[:3] == bytes((3, 0, TIME_OUT)) and bank.words[TIME_OUT] == 500:
            reads.append(pdu)
            if len(reads) > 1:
                bank.words[TIME_OUT] = 0
        return answer(pdu)

    bank.answer = forgets
    rows = refused(bank, generic)
    assert rows["watchdog"].found == "0 counts"


def test_the_setpoints_are_zero_again_before_anything_else_is_tried(bank, generic):
    """The mode is written next. No test value may remain then."""
    stood = []

    def on_write(address, words):
        if address == 4:
            stood.append([bank.words[at] for at in (1, 2, 3)])

    bank.on_write = on_write
    drive = drive_on(bank, generic)
    drive.connect()
    drive.preflight(LIMITS)
    assert stood and all(words == [0, 0, 0] for words in stood)


@pytest.mark.parametrize("echo", [48, 50])
def test_an_echo_that_falls_silent_leaves_no_setpoint_behind(bank, generic, echo):
    answer = bank.answer

    def mute(pdu):
        asked = int.from_bytes(pdu[1:3], "big")
        return b"" if pdu[0] == 3 and asked == echo else answer(pdu)

    bank.answer = mute
    drive = drive_on(bank, generic)
    drive.connect()
    with pytest.raises(CommunicationLost):
        drive.preflight(LIMITS)
    assert [bank.words[at] for at in (1, 2, 3)] == [0, 0, 0]
