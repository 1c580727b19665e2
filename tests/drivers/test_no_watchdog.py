"""Drive without a watchdog, or with one that cannot be armed, with the operator's override for it.

`test_preflight`, `test_guarding` and `test_modbus_preflight` test the refusals without the override.
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
    """Assert that it is accepted and reported, and that no message promises a stop by the drive."""
    assert found.refused == ()
    assert (found.watched, found.watchdog_s, found.safe_action) == (False, 0.0, "none")
    (said,) = [check for check in found.checks if check.name == "no watchdog"]
    assert said.outcome is Outcome.NOTE
    assert "--accept-no-watchdog" in said.found
    assert "not stop by itself" in said.found


def assert_refused(found, *titles):
    """Assert a refusal whose last row states the purpose of the override."""
    assert [check.name for check in found.refused] == list(titles)
    assert "--accept-no-watchdog" in found.refused[-1].next_step
    assert "no watchdog" not in [check.name for check in found.checks]


def test_a_watchdog_that_can_be_armed_is_armed_with_the_override_too(run):
    """The override has no effect on a drive that does not need it, as in the contract."""
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
    """An armed watchdog acts on silence, so no more frames are sent. Without one, only the quick stop remains."""
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


def test_a_profile_without_a_watchdog_and_without_an_override(canopen, peer):
    assert_refused(canopen(replace(LIMITS, accept_no_watchdog=False), kind="none", reaction="none"), "watchdog")


@pytest.mark.parametrize("how", ["absent", "refused", "deaf"])
@pytest.mark.parametrize("reaction_too", [False, True])
def test_a_consumer_heartbeat_that_cannot_be_armed(canopen, peer, how, reaction_too):
    """Without supervision, the reaction of the drive does not matter."""
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
    """An entry with node or time 0 is unused; any other entry supervises a node (CiA 301)."""
    peer.objects[0x1016, 1] = (node << 16 | time_ms).to_bytes(4, "little")
    peer.deaf_to.add((0x1016, 1))
    found = canopen()
    if off:
        assert_taken(found)
    else:
        assert_refused(found, "watchdog")
        assert "with another setting" in found.refused[-1].next_step


def test_an_armed_watchdog_with_another_reaction_stays_refused(canopen, peer):
    peer.deaf_to.add((0x6007, 0))
    assert_refused(canopen(), "watchdog reaction")


def test_an_impossible_time_stays_refused(canopen, peer):
    """An error in rig.yaml is no property of the drive."""
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
    """A guard time that is already written is restored. Otherwise it would stop the shaft later."""
    bus, store = guarded.bench.bus, guarded.bench.simulated.simulator.node.store
    asked = []

    def change(message):
        if message.arbitration_id != 0x701:
            return [message]
        asked.append(message)                               # the drive replies; the reply arrives or not
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
    guarded.drive.quick_stop()                              # and the stop of the host works
    guarded.until(guarded.rests, 5.0)
    assert len(asked) == before                             # and there are no more requests


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
def test_a_profile_without_a_time_out(modbus, watchdog):
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
    """The same applies if the checklist of the drive asks for it: off can be accepted, another value cannot."""
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
    """Without a statement the time-out may be on, as by default on some drives."""
    unseen = {"register": None, "set_to": None, "require": {"at_least": 0.05}}
    found = modbus(Bank(), given=given, time_out=unseen)
    if taken:
        assert_taken(found)
    else:
        assert found.refused


def test_a_line_too_slow_stays_refused(modbus):
    bank = Bank(takes_s=0.1)
    deaf(bank)
    assert [check.name for check in modbus(bank).refused] == ["watchdog time"]
