"""Refusals before motion: each row alone. A refused row does not prevent the checks after it."""

import dataclasses

import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import Command, Mode, Outcome
from drivers.errors import CommunicationLost, PreflightRefused
from tests.drivers.on_wire import LIMITS, cycles
from tests.drivers.power_machine import ENABLED, FAULT, OFF, REACTION, STOPPING
from tests.drivers.scripted_drive import ScriptedDrive, u

ROWS = [
    "identity", "state", "modes of operation", "rated torque", "angle of the motor", "torque limit", "speed limit",
    "quick-stop ramp", "quick-stop option", "fault reaction", "temperature", "targets", "mode display for 9",
    "mode display for 10", "PDO mapping", "cycle", "interpolation time period", "stepped time",
    "drive's heartbeat", "watchdog reaction", "watchdog",
    "speed loop: gain", "speed loop: integral", "speed loop: filter",
]


@pytest.fixture
def make(wire, profile):
    def make(clock=None, changed=profile, **options):
        return CanopenDrive(wire, changed, clock or SteppedClock(), node=1, **options)

    return make


def preflight(drive):
    drive.connect()
    return drive.preflight(LIMITS)


def refused(found):
    return {check.name: check for check in found.refused}


def changed(profile, section, **values):
    return profile.model_copy(update={section: getattr(profile, section).model_copy(update=values)})


def test_a_right_drive_passes(make, peer):
    found = preflight(make())
    assert [check.name for check in found.checks] == ROWS
    assert found.refused == ()
    assert (found.identity.vendor, found.identity.serial, found.identity.name) == (0x11, 0x44, "scripted")
    notes = {check.name for check in found.checks if check.outcome is Outcome.NOTE}
    assert notes == {"identity", "angle of the motor", "fault reaction", "temperature", *ROWS[-3:]}
    assert peer.operational


def test_values_in_the_drive_after_preflight(make, peer):
    preflight(make())
    assert peer.value(0x6072) == 300                     # ‰ of 1000 N·m
    assert peer.value(0x6080) == 96                      # 10 rad/s = 95.49 rpm, rounded up
    assert peer.value(0x6085) == 191                     # 2 rad/s² = 190.99 · 0.1 rpm/s
    assert peer.value(0x605A) == 6
    assert peer.value(0x6007) == 3
    assert peer.value(0x1016, 1) == 0x007F0190
    assert peer.value(0x1006) == 4000
    assert peer.value(0x1017) == 100
    assert peer.value(0x6071) == peer.value(0x60FF) == 0


@pytest.mark.parametrize(("option", "ends", "there", "holds"), [
    (6, None, 6, True), (5, None, 5, True), (8, None, 8, True), (2, None, 2, False),
    (4, None, 4, False), (9, None, 9, None), (-1, None, -1, None), (6, "off", 6, False), (None, None, 2, False),
    (None, None, 6, True), (None, None, None, None), (None, "quick_stop", None, True), (None, "off", None, False),
])
def test_whether_a_quick_stop_holds_the_shaft(make, peer, profile, option, ends, there, holds):
    """Options 5 to 8 of 605Ah stay in quick stop active (CiA 402-2). Without the object the profile decides."""
    if there is None:
        del peer.objects[(0x605A, 0)]
    else:
        peer.objects[(0x605A, 0)] = u(there & 0xFFFF, 2)
    entry = profile.quick_stop.model_dump(exclude_unset=True, exclude={"ends"}) | {"option_code": option}
    entry |= {} if ends is None else {"ends": ends}
    stop = type(profile.quick_stop).model_validate(entry)
    found = preflight(make(changed=profile.model_copy(update={"quick_stop": stop})))
    assert found.refused == ()
    assert found.quick_stop_holds is holds


def without_option(profile):
    return changed(profile, "quick_stop", option_code=None)


@pytest.mark.parametrize("option", [None, 6])
def test_a_quick_stop_that_coasts_is_refused_for_any_profile(make, peer, profile, option):
    """605Ah is 0, and the drive does not accept the value that the profile names."""
    peer.objects[(0x605A, 0)] = u(0, 2)
    peer.deaf_to.add((0x605A, 0))
    found = preflight(make(changed=changed(profile, "quick_stop", option_code=option)))
    row = refused(found)["quick-stop option"]
    assert (row.where, row.found[0]) == ("605Ah", "0")
    assert list(refused(found)) == ["quick-stop option"]


def test_a_quick_stop_that_coasts_is_named_so(make, peer, profile):
    peer.objects[(0x605A, 0)] = u(0, 2)
    row = refused(preflight(make(changed=without_option(profile))))["quick-stop option"]
    assert "coast" in row.found and "605Ah to 6" in row.next_step
    assert not [entry for entry in peer.writes if entry[0] == 0x605A]


def test_a_quick_stop_option_that_the_profile_does_not_name_is_shown(make, peer, profile):
    row = next(one for one in preflight(make(changed=without_option(profile))).checks if one.where == "605Ah")
    assert (row.name, row.found, row.outcome) == ("quick-stop option", "2", Outcome.OK)


def test_a_quick_stop_option_that_can_not_be_read_is_named(make, peer, profile):
    del peer.objects[(0x605A, 0)]
    found = preflight(make(changed=without_option(profile)))
    row = next(one for one in found.checks if one.where == "605Ah")
    assert (row.name, row.outcome, found.refused) == ("quick-stop option", Outcome.NOTE, ())
    assert row.found.startswith("not readable") and "quick stop brakes" in row.next_step


@pytest.mark.parametrize(("code", "said", "next_step"), [
    (0, "shaft coasts", "605Eh to 2"), (1, "slow-down ramp", ""), (2, "quick-stop ramp", ""), (3, "current limit", ""),
    (4, "voltage limit", ""), (-2, "manufacturer", "manual"), (9, "reserved", "manual"),
])
@pytest.mark.parametrize("reaction", ["fault_reaction", "quick_stop"])
def test_what_the_drive_does_in_a_fault_is_shown(make, peer, profile, code, said, next_step, reaction):
    """Codes of 605Eh (CiA 402-2). A watchdog that trips into a fault coasts with 0."""
    peer.objects[0x605E, 0] = u(code, 2)
    found = preflight(make(changed=changed(profile, "watchdog", reaction=reaction)))
    (row,) = [check for check in found.checks if check.where == "605Eh"]
    assert (row.name, row.outcome, found.refused) == ("fault reaction", Outcome.NOTE, ())
    assert row.found.startswith(f"{code}: ") and said in row.found
    assert next_step in row.next_step and bool(row.next_step) is bool(next_step)
    coasts = reaction == "fault_reaction" and code == 0
    assert found.safe_action == ("coast" if coasts else reaction)
    assert ("coasts" in found.reaction) is coasts
    assert not [entry for entry in peer.writes if entry[0] == 0x605E]


@pytest.mark.parametrize(("reaction", "rows"), [("fault_reaction", ["not in the drive"]), ("quick_stop", [])])
def test_a_drive_without_a_fault_reaction_option(make, peer, profile, reaction, rows):
    del peer.objects[0x605E, 0]
    found = preflight(make(changed=changed(profile, "watchdog", reaction=reaction)))
    assert [check.found for check in found.checks if check.where == "605Eh"] == rows
    assert (found.safe_action, found.refused) == (reaction, ())


def test_a_drive_without_a_watchdog_has_no_reaction_in_a_fault(make, peer, profile):
    peer.objects[0x605E, 0] = u(0, 2)
    peer.refuse_write[0x1016, 1] = 0x06040043
    assert preflight(make(changed=changed(profile, "watchdog", reaction="fault_reaction"))).safe_action == "none"


@pytest.mark.parametrize("code", [0x06010001, 0x06010000])
def test_a_mode_that_can_only_be_written(make, peer, code):
    """CiA 402 permits 6060h as write-only. 6061h confirms the mode, and no former mode is restored."""
    peer.refuse_read[0x6060, 0] = code
    drive = make()
    assert preflight(drive).refused == ()
    assert [data for index, _, data in peer.writes if index == 0x6060] == [b"\x09", b"\x0a"]
    assert drive.close() == ()
    assert [data for index, _, data in peer.writes if index == 0x6060] == [b"\x09", b"\x0a"]


def period(peer):
    return peer.value(0x60C2, 1), int.from_bytes(peer.objects[0x60C2, 2], "little", signed=True)


def test_the_interpolation_time_period_is_set_and_given_back(make, peer, wire):
    drive = make()
    assert preflight(drive).refused == ()
    assert period(peer) == (4, -3)
    drive.set_rate(800.0)
    assert period(peer) == (125, -5)
    drive.set_rate(125.0)
    assert period(peer) == (8, -3)
    wire.sent.clear()
    cycles(drive, wire, 300, Command(Mode.SPEED, 0.0, 0.0))
    assert not [data for data in wire.of(0x601) if data[1:3] == b"\xc2\x60"]
    assert drive.close() == ()
    assert period(peer) == (1, -3)


def test_profile_modes_have_no_interpolation_time_period(make, peer):
    peer.objects[0x6502, 0] = u(1 << 2 | 1 << 3, 4)
    assert "interpolation time period" not in [check.name for check in preflight(make()).checks]
    assert period(peer) == (1, -3)


@pytest.mark.parametrize(("refused_at", "left"), [
    ({"refuse_read": (1, 2)}, (1, -3)), ({"refuse_write": (1, 2)}, (1, -3)), ({"refuse_write": (1,)}, (1, -3)),
])
def test_a_drive_that_refuses_the_interpolation_time_period_goes_on(make, peer, refused_at, left):
    """The period stays the former one: not the former value with another exponent."""
    for how, subs in refused_at.items():
        getattr(peer, how).update({(0x60C2, sub): 0x06090030 for sub in subs})
    drive = make(rate_hz=800.0)
    found = preflight(drive)
    (row,) = [check for check in found.checks if check.name == "interpolation time period"]
    assert (found.refused, row.outcome, row.where) == ((), Outcome.NOTE, "60C2h")
    assert row.found.startswith("1250 µs, not set: ") and "06090030" in row.found
    assert period(peer) == left
    assert drive.close() == ()                     # a change that was refused leaves nothing to restore
    assert period(peer) == left


def test_preflight_does_not_enable_the_drive(make, peer, wire):
    preflight(make())
    assert peer.machine.state == OFF
    assert not [entry for entry in peer.writes if entry[0] == 0x6040]
    assert wire.of(0x201) == wire.of(0x080) == []


def test_the_watchdog_is_fed_before_it_is_read_back(make, peer, wire):
    """The supervision of the drive begins with the first heartbeat."""
    preflight(make(host_node=99))
    frames = [(identifier, data.hex()) for identifier, data in wire.sent]
    armed = frames.index((0x601, "2316100190016300"))
    fed = frames.index((0x763, "05"))
    assert armed < fed
    assert (0x601, "4016100100000000") in frames[fed:]


@pytest.mark.parametrize(("field", "row"), [
    ("vendor", "identity: vendor"), ("product", "identity: product"), ("revision", "identity: revision"),
])
def test_another_drive(make, peer, profile, field, row):
    found = preflight(make(changed=changed(profile, "identity", **{field: 0x99})))
    assert list(refused(found)) == [row]
    check = refused(found)[row]
    assert (check.wanted, check.where) == ("99h", "1018h")
    assert "--profile" in check.next_step
    assert [row.name for row in found.checks][1:] == ROWS[1:]


def test_the_right_drive(make, peer, profile):
    found = preflight(make(changed=changed(profile, "identity", vendor=0x11, product=0x22, revision=0x33)))
    assert found.refused == ()


def test_a_fault_at_the_start_is_refused_and_left_alone(make, peer):
    peer.machine.state = FAULT
    drive = make()
    found = preflight(drive)
    assert list(refused(found)) == ["state"]
    assert "7305h" in refused(found)["state"].found
    assert "--reset-fault" in refused(found)["state"].next_step
    drive.enable(Mode.SPEED)
    for _ in range(20):
        drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert peer.machine.state == FAULT
    assert all(word & 0x80 == 0 for word, _, _ in peer.setpoints)


@pytest.mark.parametrize("before", [0x00, 0x80, 0x8F])
def test_a_requested_reset_is_an_edge(make, peer, before):
    peer.machine.state, peer.machine.word = FAULT, before
    drive = make()
    drive.connect()
    drive.reset_fault()
    assert peer.machine.state == OFF
    words = [int.from_bytes(data, "little") for index, _, data in peer.writes if index == 0x6040]
    assert [word >> 7 & 1 for word in words] == [0, 1, 0]
    assert all(word & 0x0F == 0 for word in words)
    assert drive.preflight(LIMITS).refused == ()


def test_a_drive_that_another_master_runs(make, peer):
    peer.machine.state = ENABLED
    drive = make()
    with pytest.raises(PreflightRefused, match="another master"):
        drive.connect()
    drive.close()
    assert peer.writes == []
    assert not peer.operational


@pytest.mark.parametrize(("velocity", "good"), [(0, True), (4, True), (300, False), (-300, False)])
def test_a_drive_that_still_brakes_after_a_stop_is_left_alone(make, peer, velocity, good):
    peer.machine.state = STOPPING
    peer.objects[0x606C, 0] = velocity.to_bytes(4, "little", signed=True)
    drive = make()
    assert ("state" not in refused(preflight(drive))) == good
    if not good:                       # neither mode nor quick-stop option is changed in motion
        drive.close()
        assert peer.writes == []
        assert peer.machine.state == STOPPING


def test_three_coarse_counts_are_no_standstill(make, peer, profile):
    """A count is 1 rpm. 3 rpm is 0.31 rad/s, and standstill is at most 0.2 rad/s."""
    peer.machine.state, peer.objects[0x606C, 0] = STOPPING, u(3, 4)
    assert "state" in refused(preflight(make(changed=changed(profile, "speed", rpm_per_lsb=1.0))))
    assert peer.writes == []


def test_a_fault_reaction_is_left_alone_too(make, peer):
    peer.machine.state = REACTION
    assert "state" in refused(preflight(make()))
    assert peer.writes == []


@pytest.mark.parametrize("state", [STOPPING, REACTION, OFF])
def test_a_drive_that_is_not_in_fault_is_not_reset(make, peer, state):
    """The low word of the edge is 'disable voltage', which would release a shaft that brakes or is held."""
    peer.machine.state = state
    drive = make()
    drive.connect()
    drive.reset_fault()
    assert peer.writes == []
    assert peer.machine.state == state


@pytest.mark.parametrize(("string", "torque", "let_go"), [
    (True, 250, False), (True, -250, False), (True, None, False), (True, 4, True), (False, 250, True),
])
def test_a_string_that_is_held_wound_up_is_not_let_go_by_the_next_run(make, peer, string, torque, let_go):
    peer.machine.state = STOPPING
    peer.objects[0x606C, 0] = u(0, 4)
    if torque is not None:
        peer.objects[0x6077, 0] = u(torque, 2)
    drive = make()
    drive.connect()
    found = drive.preflight(dataclasses.replace(LIMITS, string=string))
    assert ("torque held in quick stop" in refused(found)) is not let_go
    if not let_go:
        drive.close()
        assert peer.writes == []
        assert peer.machine.state == STOPPING


def test_a_torque_limit_below_one_count_is_no_wider_one(make, peer, profile):
    coarse = changed(profile, "torque", max_torque_rated_per_lsb=0.5)
    drive = make(changed=coarse)
    drive.connect()
    row = refused(drive.preflight(LIMITS))["torque limit"]
    assert (row.wanted, row.found) == ("300 N·m", "one count is 500 N·m")
    assert peer.value(0x6072) == 900


def test_no_rated_torque(make, peer):
    del peer.objects[0x6076, 0]
    found = preflight(make())
    check = refused(found)["rated torque"]
    assert check.where == "6076h"
    assert "rig.yaml" in check.next_step
    assert [check.name for check in found.checks] == ROWS


def test_rated_torque_from_the_rig(make, peer, profile):
    del peer.objects[0x6076, 0]
    found = preflight(make(rated_torque_nm=500.0))
    assert found.refused == ()
    assert (found.rated_torque_nm, found.torque_resolution_nm) == (500.0, 0.5)
    assert peer.value(0x6072) == 600


@pytest.mark.parametrize(("rig", "good"), [(1000.0, True), (1000.9, True), (1002.0, False), (500.0, False)])
def test_rated_torque_from_both(make, peer, rig, good):
    found = preflight(make(rated_torque_nm=rig))
    assert ("rated torque" not in refused(found)) == good


LIMIT_OBJECTS = [(0x6072, "torque limit"), (0x6080, "speed limit"), (0x6085, "quick-stop ramp"),
                 (0x605A, "quick-stop option"), (0x1006, "cycle"), (0x1017, "drive's heartbeat"),
                 (0x6007, "watchdog reaction"), (0x60C2, "interpolation time period")]


@pytest.mark.parametrize(("index", "row"), LIMIT_OBJECTS)
def test_acknowledged_but_not_stored(make, peer, index, row):
    peer.deaf_to |= {(index, 0), (index, 1)}
    found = preflight(make())
    assert list(refused(found)) == [row]
    assert refused(found)[row].where == f"{index:04X}h"
    assert [check.name for check in found.checks] == ROWS


@pytest.mark.parametrize(("index", "row"), [pair for pair in LIMIT_OBJECTS if pair[0] not in (0x1006, 0x1017, 0x60C2)])
def test_refused_by_the_drive(make, peer, index, row):
    peer.refuse_write[index, 0] = 0x06090031
    found = preflight(make())
    assert list(refused(found)) == [row]
    assert "06090031" in refused(found)[row].found.upper()
    assert [check.name for check in found.checks] == ROWS


def test_limits_that_are_there_already(make, peer):
    peer.objects[0x6072, 0] = u(300, 2)
    assert preflight(make()).refused == ()
    assert not [entry for entry in peer.writes if entry[0] == 0x6072]


@pytest.mark.parametrize("index", [0x6071, 0x60FF])
def test_a_target_that_cannot_be_cleared(make, peer, index):
    peer.refuse_write[index, 0] = 0x06020000
    found = preflight(make())
    assert refused(found)["targets"].where == f"{index:04X}h"
    assert [check.name for check in found.checks] == ROWS


def test_the_mode_display_does_not_follow(make, peer, fake_time):
    peer.deaf_to.add((0x6061, 0))
    begin_s = fake_time.now_s
    found = preflight(make())
    assert list(refused(found)) == ["mode display for 9", "mode display for 10"]
    assert refused(found)["mode display for 9"].found == "3"
    assert fake_time.now_s - begin_s < 5.0


def test_a_mode_display_that_follows_late(make, peer, wire):
    peer.deaf_to.add((0x6061, 0))
    reads = []

    def follow(request):
        if request[:3] == b"\x40\x61\x60":
            reads.append(request)
            if len(reads) % 4 == 0:
                peer.objects[0x6061, 0] = peer.objects[0x6060, 0]

    peer.before_answer = follow
    assert preflight(make()).refused == ()


def bits(*modes):
    return u(sum(1 << mode - 1 for mode in modes), 4)


@pytest.mark.parametrize(("modes", "chosen"), [
    ((3, 4, 9, 10), {Mode.SPEED: 9, Mode.TORQUE: 10}), ((3, 4), {Mode.SPEED: 3, Mode.TORQUE: 4}),
    ((9, 4), {Mode.SPEED: 9, Mode.TORQUE: 4}), ((1, 3, 8), {Mode.SPEED: 3}),
])
def test_modes_that_the_drive_has(make, peer, wire, modes, chosen):
    peer.objects[0x6502, 0] = bits(*modes)
    drive = make()
    found = preflight(drive)
    assert found.refused == ()
    assert found.modes == set(chosen)
    for mode, code in chosen.items():
        wire.sent.clear()
        drive.exchange(Command(mode, 0.0, 0.0))
        assert wire.of(0x301) == [bytes([code])]


def test_no_speed_mode(make, peer):
    peer.objects[0x6502, 0] = bits(1, 4, 6)
    found = preflight(make())
    assert list(refused(found)) == ["modes of operation"]
    assert refused(found)["modes of operation"].where == "6502h"


def test_a_mode_that_was_not_found_cannot_be_requested(make, peer):
    peer.objects[0x6502, 0] = bits(3)
    drive = make()
    preflight(drive)
    with pytest.raises(PreflightRefused, match="torque"):
        drive.enable(Mode.TORQUE)


@pytest.mark.parametrize("how", ["absent", "refused", "deaf"])
def test_a_watchdog_that_cannot_be_armed(make, peer, how):
    if how == "absent":
        del peer.objects[0x1016, 1]
    elif how == "refused":
        peer.refuse_write[0x1016, 1] = 0x06040043
    else:
        peer.deaf_to.add((0x1016, 1))
    found = preflight(make())
    assert list(refused(found)) == ["watchdog"]
    assert refused(found)["watchdog"].where == "1016h:1"
    assert "host" in refused(found)["watchdog"].next_step


def test_a_drive_without_a_watchdog(make, peer, profile):
    found = preflight(make(changed=changed(profile, "watchdog", kind="none", reaction="none")))
    assert list(refused(found)) == ["watchdog"]
    assert found.safe_action == "none"


@pytest.mark.parametrize("marker", [None, b"some other drive", b"tdhil simulated drive 2"])
def test_stepped_time_is_for_simulated_drives(make, wire, marker):
    peer = ScriptedDrive(wire, marker=False)
    if marker is not None:
        peer.objects[0x5FFE, 1] = marker
    with pytest.raises(PreflightRefused, match="marker") as caught:
        make().connect()
    assert caught.value.where == "5FFEh:1"
    assert "--stepped" in caught.value.next_step


def test_a_real_drive_is_never_written_to_in_the_manufacturers_range(make, wire):
    peer = ScriptedDrive(wire, marker=False)
    found = preflight(make(MonotonicClock()))
    assert found.refused == ()
    assert not found.identity.simulated
    assert "stepped time" not in [check.name for check in found.checks]
    assert not [entry for entry in peer.writes if 0x2000 <= entry[0] < 0x6000]


def test_a_simulated_drive_may_keep_its_own_time(make, peer):
    found = preflight(make(MonotonicClock()))
    assert found.identity.simulated
    assert not [entry for entry in peer.writes if entry[0] == 0x5FFE]


@pytest.mark.parametrize(("index", "row"), [(0x1006, "cycle"), (0x1017, "drive's heartbeat")])
def test_objects_that_a_drive_may_lack(make, peer, index, row):
    del peer.objects[index, 0]
    found = preflight(make())
    assert found.refused == ()
    assert next(check for check in found.checks if check.name == row).outcome is Outcome.NOTE


def test_a_drive_without_a_demand_is_mapped_without_it(make, peer):
    del peer.objects[0x6074, 0]
    assert preflight(make()).refused == ()
    assert peer.value(0x1A01) == 1


def test_a_drive_with_a_fixed_mapping(make, peer):
    peer.refuse_write[0x1A00, 0] = 0x06010002
    found = preflight(make())
    assert list(refused(found)) == ["PDO mapping"]
    assert refused(found)["PDO mapping"].where == "1A00h"


def test_a_temperature_limit_without_monitoring_is_refused(make, peer):
    drive = make()
    drive.connect()
    found = drive.preflight(dataclasses.replace(LIMITS, temperature_c=90.0))
    assert [check.where for check in found.refused] == ["limits.temperature_c"]


def test_all_errors_at_once(make, peer, profile):
    peer.machine.state = FAULT
    peer.objects[0x6502, 0] = bits(4)
    del peer.objects[0x6076, 0]
    peer.deaf_to |= {(index, 0) for index in (0x6080, 0x6085, 0x605A, 0x6061, 0x1006, 0x1017, 0x6007)}
    peer.refuse_write |= {(0x1016, 1): 0x06040043, (0x6071, 0): 0x06020000, (0x1600, 0): 0x06010002}
    found = preflight(make(changed=changed(profile, "identity", vendor=0x99)))
    rows = [check.name for check in found.checks]
    by_row = {"identity": "identity: vendor", "mode display for 9": None, "mode display for 10": "mode display for 4",
              "interpolation time period": None}           # 4 is a profile mode
    assert rows == [name for row in ROWS if (name := by_row.get(row, row))]
    good = {"stepped time", "angle of the motor", "temperature", "fault reaction", *ROWS[-3:],
            "torque limit"}                                # tighter, so it stays
    assert set(refused(found)) == set(rows) - good
    assert all(check.where for check in found.refused)


@pytest.mark.parametrize("step", ["connect", "preflight"])
def test_nobody_there(make, peer, step):
    drive = make()
    if step == "preflight":
        drive.connect()
    peer.silent = True
    with pytest.raises(PreflightRefused if step == "connect" else CommunicationLost, match="does not answer") as caught:
        drive.connect() if step == "connect" else drive.preflight(LIMITS)
    assert "bit rate" in caught.value.next_step


def test_settings_of_a_refused_preflight_are_restored_on_close(make, peer):
    before = dict(peer.objects)
    peer.deaf_to.add((0x6061, 0))
    drive = make()
    preflight(drive)
    drive.close()
    kept = [key for key in before if 0x1400 <= key[0] < 0x1C00 or key[0] in (0x6060, 0x6071, 0x60FF)]
    assert {key: value for key, value in peer.objects.items() if key not in kept} == {
        key: value for key, value in before.items() if key not in kept
    }
    assert not peer.operational


# -- limits of the drive itself ----------------------------------------------------------------------------------


TIGHT = {0x6072: 100, 0x6080: 40, 0x6085: 1910}        # 100 N·m, 4.19 rad/s, 20 rad/s²; LIMITS ask 300, 10, 2
WIDER = {"torque": 0x6072, "speed": 0x6080, "quick-stop": 0x6085}


@pytest.fixture
def tight(wire):
    peer = ScriptedDrive(wire, marker=False)
    for index, raw in TIGHT.items():
        peer.objects[index, 0] = raw.to_bytes(len(peer.objects[index, 0]), "little")
    return peer


def test_a_tighter_limit_of_the_drive_s_own_stays(make, tight):
    drive = make(MonotonicClock())
    found = preflight(drive)
    assert found.refused == ()
    assert {index: tight.value(index) for index in TIGHT} == TIGHT
    assert not [entry for entry in tight.writes if entry[0] in TIGHT]
    assert (found.kept_torque_nm, found.kept_speed_rad_s) == (pytest.approx(100.0), pytest.approx(4.18879))
    rows = {check.name: check for check in found.checks}
    for row, text, flag in (("torque limit", "100 N·m", "torque"), ("speed limit", "4.18879 rad/s", "speed"),
                            ("quick-stop ramp", "20.0015 rad/s²", "quick-stop")):
        assert rows[row].outcome is Outcome.NOTE
        assert text in rows[row].found
        assert "kept" in rows[row].found
        assert f"--accept-wider-limit {flag}" in rows[row].next_step


@pytest.mark.parametrize("limit", sorted(WIDER))
def test_it_is_widened_by_name_and_no_other_with_it(make, tight, limit):
    drive = make(MonotonicClock())
    drive.connect()
    found = drive.preflight(dataclasses.replace(LIMITS, accept_wider=frozenset({limit})))
    changed = {index for index, raw in TIGHT.items() if tight.value(index) != raw}
    assert changed == {WIDER[limit]}
    (row,) = [check for check in found.checks if "accepted by --accept-wider-limit" in check.found]
    assert row.outcome is Outcome.NOTE
    assert row.where == f"{WIDER[limit]:04X}h"
    before = {"torque": "was 100 N·m", "speed": "was 4.18879 rad/s", "quick-stop": "was 20.0015 rad/s²"}[limit]
    assert before in row.found
    drive.close()
    assert {index: tight.value(index) for index in TIGHT} == TIGHT


def test_a_wider_limit_is_tightened_without_a_request_and_both_values_are_reported(make, peer):
    rows = {check.name: check for check in preflight(make()).checks}
    assert rows["torque limit"].found == "300 N·m (was 900 N·m)"
    assert rows["torque limit"].outcome is Outcome.OK


def test_a_torque_limit_between_two_counts_is_rounded_down(make, peer):
    """Rounding up would permit more torque than rig.yaml allows."""
    drive = make()
    drive.connect()
    drive.preflight(dataclasses.replace(LIMITS, torque_nm=299.7))
    assert peer.value(0x6072) == 299
