"""A drive without a watchdog, or with one that can't be armed, once the operator has accepted just that by name.

What is refused without it is `test_preflight`'s, `test_guarding`'s and `test_modbus_preflight`'s concern.
"""

import json
from contextlib import suppress
from dataclasses import replace

import can
import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import SteppedClock
from drivers.drive import Command, Mode, Outcome
from drivers.errors import CommunicationLost
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile
from tests.drivers import drive_benches
from tests.drivers.drive_benches import Run
from tests.drivers.modbus_bank import CONTROL, TIME_OUT, Bank
from tests.drivers.on_wire import TURN, cycles, enabled
from tests.drivers.power_machine import ENABLED, STOPPING
from tests.drivers.profile_benches import S120Bench

LIMITS = replace(drive_benches.LIMITS, accept_no_watchdog=True,
                 accept_wider=frozenset({"torque", "speed", "quick-stop"}))
REACTION = 41


def assert_taken(found):
    """Not refused, never silent, and nobody is told that the drive would stop by itself."""
    assert found.refused == ()
    assert (found.watched, found.watchdog_s, found.safe_action) == (False, 0.0, "none")
    (said,) = [check for check in found.checks if check.name == "no watchdog"]
    assert said.outcome is Outcome.NOTE
    assert "--accept-no-watchdog" in said.found
    assert "not stop by itself" in said.found


def assert_refused(found, *titles):
    """The last of the rows says what the flag is for."""
    assert [check.name for check in found.refused] == list(titles)
    assert "--accept-no-watchdog" in found.refused[-1].next_step
    assert "no watchdog" not in [check.name for check in found.checks]


def test_a_drive_that_can_be_armed_is_armed_all_the_same(run):
    """Of the contract: the operator's word changes nothing on a drive that doesn't need it."""
    run.drive.connect()
    found = run.drive.preflight(replace(run.bench.limits, accept_no_watchdog=True))
    assert found.refused == ()
    assert found.watched
    assert found.watchdog_s == run.bench.limits.watchdog_s
    assert found.safe_action == run.bench.safe_action
    assert not [check for check in found.checks if "--accept-no-watchdog" in check.found]


# -- CANopen ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def canopen(wire, profile):
    def preflight(limits=LIMITS, **watchdog):
        changed = profile.model_copy(update={"watchdog": profile.watchdog.model_copy(update=watchdog)})
        drive = CanopenDrive(wire, changed, SteppedClock(), node=1)
        drive.connect()
        return drive.preflight(limits)

    return preflight


@pytest.mark.parametrize("kind", ["none", "heartbeat"])
def test_a_full_queue_keeps_no_stop_back_where_no_watchdog_acts(wire, peer, profile, kind):
    """With one armed nothing more is sent: it acts on the silence. Without one the quick stop is all that there is."""
    none = {"kind": "none", "reaction": "none", "reaction_index": None, "reaction_value": None}
    watchdog = profile.watchdog.model_copy(update=none if kind == "none" else {})
    drive = enabled(wire, profile.model_copy(update={"watchdog": watchdog}), LIMITS)
    cycles(drive, wire, 10)
    assert peer.machine.state == ENABLED
    wire.send_error = can.CanOperationError("transmit buffer full")
    with pytest.raises(CommunicationLost):
        drive.exchange(TURN)
    wire.send_error = None
    drive.quick_stop()
    for _ in range(3):
        wire.put(0x701, b"\x05")
        with suppress(CommunicationLost):
            drive.exchange(Command(Mode.SPEED, 0.0, 0.0))
    assert peer.machine.state == (STOPPING if kind == "none" else ENABLED)


def test_a_profile_without_a_watchdog(canopen, peer):
    assert_taken(canopen(kind="none", reaction="none", reaction_index=None, reaction_value=None))
    assert not [entry for entry in peer.writes if entry[0] in (0x1016, 0x6007)]


def test_a_profile_without_a_watchdog_that_nobody_accepted(canopen, peer):
    assert_refused(canopen(replace(LIMITS, accept_no_watchdog=False), kind="none", reaction="none"), "watchdog")


@pytest.mark.parametrize("how", ["absent", "refused", "deaf"])
@pytest.mark.parametrize("reaction_too", [False, True])
def test_a_consumer_heartbeat_that_cannot_be_armed(canopen, peer, how, reaction_too):
    """Where nothing is watched, how the drive would react doesn't matter."""
    for key in [(0x1016, 1), (0x6007, 0)][: 1 + reaction_too]:
        if how == "absent":
            del peer.objects[key]
        elif how == "refused":
            peer.refuse_write[key] = 0x06040043
        else:
            peer.deaf_to.add(key)
    found = canopen()
    assert_taken(found)
    notes = {check.name: check.found for check in found.checks if check.outcome is Outcome.NOTE}
    assert "accepted by --accept-no-watchdog" in notes["watchdog"]
    assert ("watchdog reaction" in notes) is reaction_too


@pytest.mark.parametrize(("node", "time_ms", "off"), [
    (0, 0, True), (0, 500, True), (127, 0, True), (127, 501, False), (127, 499, False), (5, 500, False),
    (127, 65535, False), (1, 1, False),
])
def test_a_consumer_that_is_set_otherwise_stays_refused(canopen, peer, node, time_ms, off):
    """CiA 301: an entry whose node or time is 0 isn't used; any other supervises somebody."""
    peer.objects[0x1016, 1] = (node << 16 | time_ms).to_bytes(4, "little")
    peer.deaf_to.add((0x1016, 1))
    found = canopen()
    if off:
        assert_taken(found)
    else:
        assert_refused(found, "watchdog")
        assert "with another setting" in found.refused[-1].next_step


def test_a_watchdog_that_is_armed_and_does_something_else_stays_refused(canopen, peer):
    peer.deaf_to.add((0x6007, 0))
    assert_refused(canopen(), "watchdog reaction")


def test_a_time_that_can_not_be_is_refused_as_ever(canopen, peer):
    """A mistake in rig.yaml is no property of the drive."""
    found = canopen(replace(LIMITS, watchdog_s=0.005))
    assert [check.name for check in found.refused] == ["watchdog time"]
    assert peer.value(0x1016, 1) == 0


def test_other_refusals_stay(canopen, peer):
    del peer.objects[0x1016, 1]
    peer.deaf_to.add((0x6080, 0))
    assert [check.name for check in canopen().refused] == ["speed limit"]


@pytest.fixture
def guarded(open_bench):
    return Run(open_bench(S120Bench))


@pytest.mark.parametrize("how", ["no answer", "no object"])
def test_node_guarding_that_does_not_work(guarded, how):
    """A guard time that was written already is taken back: else it stops the shaft some time later, unasked."""
    bus, store = guarded.bench.bus, guarded.bench.simulated.simulator.node.store
    asked = []

    def change(message):
        if message.arbitration_id != 0x701:
            return [message]
        asked.append(message)                               # the drive answers; it arrives or not
        return [] if how == "no answer" else [message]

    bus.change = change
    if how == "no object":
        store.remove(0x100D)
    guarded.drive.connect()
    assert_taken(guarded.drive.preflight(replace(guarded.bench.limits, accept_no_watchdog=True)))
    assert guarded.bench.read(0x100C) == 0
    before = len(asked)
    assert before == (how == "no answer")
    guarded.enable(Mode.SPEED)
    guarded.go(2.0, speed=2.0)                              # nothing trips, on either side
    guarded.drive.quick_stop()                              # and the host's own stop works
    guarded.until(guarded.rests, 5.0)
    assert len(asked) == before                             # and it isn't asked any more


# -- Modbus -----------------------------------------------------------------------------------------------------------

NONE = {"kind": "none", "parameter": None, "reaction": "none", "reaction_parameter": None}


@pytest.fixture(scope="module")
def generic():
    return load_modbus_profile("generic/modbus").model_dump(by_alias=True)


@pytest.fixture
def modbus(generic):
    def preflight(bank, limits=LIMITS, *, watchdog=None, given=None, **parameters):
        data = generic | {"watchdog": generic["watchdog"] | (watchdog or {})}
        data["parameters"] = [one | parameters.get(one["name"], {}) for one in data["parameters"]]
        profile = ModbusProfile.model_validate_json(json.dumps(data))
        drive = ModbusDrive(EmbeddedLink(bank.serve, SteppedClock()), profile, unit=1, given=given)
        drive.connect()
        found = drive.preflight(limits)
        assert {words[0] for address, words in bank.writes if address == CONTROL} <= {0}
        return found

    return preflight


@pytest.mark.parametrize("watchdog", [NONE, {"parameter": None}], ids=["none", "nowhere"])
def test_a_profile_that_knows_no_time_out(modbus, watchdog):
    assert_taken(modbus(Bank(), watchdog=watchdog))
    assert_refused(modbus(Bank(), replace(LIMITS, accept_no_watchdog=False), watchdog=watchdog), "watchdog")


def deaf(bank):
    bank.deaf_to.add(TIME_OUT)


def locked(bank):
    bank.refuse_at[TIME_OUT] = 2


def both_locked(bank):
    bank.refuse_at |= {TIME_OUT: 2, REACTION: 2}


@pytest.mark.parametrize("how", [deaf, locked, both_locked])
def test_a_time_out_that_cannot_be_set(modbus, how):
    for accepted in (False, True):
        bank = Bank()
        how(bank)
        found = modbus(bank, replace(LIMITS, accept_no_watchdog=accepted))
        if accepted:
            assert_taken(found)
        else:
            assert found.refused


@pytest.mark.parametrize("counts", [1, 250, 499, 501])
def test_a_time_out_that_is_set_otherwise_stays_refused(modbus, counts):
    bank = Bank()
    bank.words[TIME_OUT] = counts
    deaf(bank)
    found = modbus(bank)
    assert_refused(found, "time-out of the host's writing")
    assert "with another setting" in found.refused[-1].next_step


def test_a_reaction_that_is_wrong_stays_refused_where_the_time_can_be_set(modbus):
    bank = Bank()
    bank.words[REACTION] = 2
    assert [check.where for check in modbus(bank).refused] == ["register 41"]


@pytest.mark.parametrize(("counts", "taken"), [(0, True), (40, False), (501, False), (60_000, False)])
def test_a_time_out_that_is_set_by_hand(modbus, counts, taken):
    """So it is where the drive's checklist asks for it too: off is one thing, otherwise another."""
    for require in ({}, {"require": {"at_least": 0.05}}):
        bank = Bank()
        bank.words[TIME_OUT] = counts
        bank.words[REACTION] = 2 if counts == 0 else 3
        found = modbus(bank, time_out={"set_to": None, **require})
        if taken:
            assert_taken(found)
        else:
            assert found.refused and not any("no watchdog" in check.name for check in found.checks)


@pytest.mark.parametrize(("given", "taken"), [({"time_out": 0.0}, True), ({"time_out": 3.0}, False), ({}, False)])
def test_a_time_out_that_no_register_shows(modbus, given, taken):
    """What nobody has stated isn't known to be off; on some drives it is on when they leave the factory."""
    unseen = {"register": None, "set_to": None, "require": {"at_least": 0.05}}
    found = modbus(Bank(), given=given, time_out=unseen)
    if taken:
        assert_taken(found)
    else:
        assert found.refused


def test_a_line_too_slow_is_refused_as_ever(modbus):
    bank = Bank(takes_s=0.1)
    deaf(bank)
    assert [check.name for check in modbus(bank).refused] == ["watchdog time"]
