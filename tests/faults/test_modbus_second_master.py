"""Rows from 66 on: other clients of a Modbus drive that read, command or change settings; checks of the true shaft."""

import math
import struct

import pytest

from profiles.library import load_modbus_profile, profile_path
from sim_bus.modbus import embedded
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams
from tests.faults.rehearsal import at, run
from tests.path.path_runs import REAL, Shaft, identify, modbus_peer
from tests.rigs import limits_text, rig_file

BY_NAME = "--accept-shared-watchdog"
TURNING_RAD_S = 0.3


def fed_by(folder, what):
    """Return a file with the profile generic/modbus and another source that feeds the watchdog."""
    path = folder / "fed.yaml"
    path.write_text(profile_path("generic/modbus").read_text().replace("fed_by: writes", f"fed_by: {what}"))
    return path


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("what", "runs_on"), [
    ("any_request", True), ("requests_of_this_connection", False), ("writes", False), ("control_word", False),
    ("writes_of_this_connection", False),
])
def test_a_host_dies_while_another_client_reads(tmp_path, what, runs_on):
    """On the simulated drive itself, the shaft turns on only if any request feeds the watchdog."""
    trace = tmp_path / "shaft.csv"
    with EmbeddedModbusDrive(RigParams(), load_modbus_profile(str(fed_by(tmp_path, what))), trace=trace) as drive:
        now_s = 0.0

        def ask(pdu, connection):
            nonlocal now_s
            now_s = drive.serve(1, pdu, now_s + 0.05, connection)[1]

        for pdu in (struct.pack(">BHH", 6, 40, 500), struct.pack(">BHHBI", 16, 1, 2, 4, 4000)):
            ask(pdu, 1)
        for word in (6, 7, *[15] * 100):
            ask(struct.pack(">BHH", 6, 0, word), 1)
        died_s = now_s
        while now_s < died_s + 10.0:
            ask(struct.pack(">BHH", 3, 16, 1), 2)
    shaft = Shaft.read(trace)
    assert shaft.speed_at(died_s) > 2.0
    assert bool(abs(shaft.speed_rad_s[-1]) > 2.0) is runs_on
    assert bool(shaft.events("host silent")) is not runs_on


@pytest.mark.heavy
def test_row_66_refused_unless_taken_by_name(tmp_path, no_bus_of_the_user, seen):
    """With a real drive in its own process there is no motion, and the message names the remedy."""
    profile = fed_by(tmp_path, "any_request")
    rig = rig_file(tmp_path, "name: bench 3\n", limits_text(watchdog_s=2.0))
    with modbus_peer(tmp_path / "shaft.csv", "--profile", profile, program=REAL) as drive:
        line = (*drive.options, "--profile", profile, "--rig", rig, "--rate", 4)
        refused = identify(tmp_path, *line, "--yes")
        taken = identify(tmp_path, *line, BY_NAME)         # and no operator confirms at the terminal
    assert refused.code == taken.code == 4
    message = refused.document["error"]["message"]
    assert "any request" in message and "will not stop by itself" in message and BY_NAME in message
    said = " ".join(taken.err.split())
    assert "may not detect a dead host" in said and "every other client of this drive is switched off" in said
    assert "no operator can confirm" in taken.document["error"]["message"]
    shaft = drive.shaft
    assert abs(shaft.speed_rad_s).max() < TURNING_RAD_S and "operation enabled" not in set(shaft.state)
    seen(66, message, None, "whole", 4)


# -- another master that commands, and one that changes settings, in stepped time ------------------------------


class Other:
    """Other client that sends requests over its own connection every ``every_s`` of plant time, from `begin` on."""

    def __init__(self, monkeypatch):
        self.pdus, self.every_s, self.next_s, self.until_s = (), 0.0, math.inf, math.inf
        run_until, other = embedded.EmbeddedModbusDrive.run_until, self

        def running(self, time_s):
            while other.next_s <= min(time_s, other.until_s):
                run_until(self, other.next_s)
                for pdu in other.pdus:
                    self._faults.request(pdu, 2)
                other.next_s += other.every_s
            run_until(self, time_s)

        monkeypatch.setattr(embedded.EmbeddedModbusDrive, "run_until", running)

    def begin(self, now_s, every_s, *pdus, lasts_s=math.inf):
        self.pdus, self.every_s, self.next_s, self.until_s = pdus, every_s, now_s + every_s, now_s + lasts_s


@pytest.fixture
def other(no_bus_of_the_user, monkeypatch):
    return Other(monkeypatch)


def command(control, speed_rad_s, torque_permille=0, mode=0):
    """Write control word, both setpoints and the mode of generic/modbus in one request."""
    rpm = round(speed_rad_s / (2.0 * math.pi / 60.0) / 0.01)
    return struct.pack(">BHHBHihH", 16, 0, 5, 10, control, rpm, torque_permille, mode)


@pytest.mark.heavy
@pytest.mark.parametrize(("hz", "pdu", "stage"), [
    (5.0, command(15, 5.0), "speed"), (50.0, command(15, 5.0), "speed"), (100.0, command(15, 5.0), "acquire"),
    (20.0, command(15, 0.0, 300, 1), "hold"), (10.0, struct.pack(">BHHBi", 16, 1, 2, 4, 4775), "speed"),
], ids=["5 Hz", "50 Hz", "100 Hz in acquire", "torque in hold", "its setpoint alone"])
def test_row_67_another_master_commands(hz, pdu, stage, other, monkeypatch, tmp_path, seen):
    """The stop prevails, the shaft comes to standstill, and the message names the other master."""
    acted = at(monkeypatch, stage, 5.0, lambda sample: other.begin(sample.time_s, 1.0 / hz, pdu))
    ended = run(tmp_path, "--drive", "modbus")
    assert ended.done.code in (5, 8), ended.done.err
    ended.assert_ended(
        ended.done.code, "another master commands this drive", "this run wrote", "Disconnect the other master",
    )
    shaft = ended.shaft
    after = shaft.time_s >= acted[0]
    assert abs(shaft.speed_rad_s[after]).max() < 7.0
    quiet = shaft.time_s >= shaft.time_s[-1] - 1.0
    assert abs(shaft.speed_rad_s[quiet]).max() < 0.2, "the other master kept the shaft turning"
    seen(67, f"{hz:g} Hz in {stage}: {ended.message}", ended.standstill_s(acted[0]) if ended.done.code == 5 else None,
         ended.assert_log_whole(), ended.done.code)


@pytest.mark.heavy
@pytest.mark.parametrize(("address", "value", "words"), [
    (40, 0, ("register 40", "time-out", "was 0.5 s, and is 0 s")),
    (41, 0, ("register 41", "reaction", "was 3, and is 0")),
    (38, 4000, ("register 38", "was 0.4 of rated torque, and is 4 of rated torque")),
], ids=["watchdog off", "reaction", "torque limit"])
def test_row_68_somebody_changes_a_setting_in_motion(address, value, words, other, monkeypatch, tmp_path, seen):
    """It writes once, like a commissioning tool. If the host died later, no watchdog would stop the shaft."""
    pdu = struct.pack(">BHH", 6, address, value)
    acted = at(monkeypatch, "speed", 5.0, lambda sample: other.begin(sample.time_s, 0.05, pdu, lasts_s=0.06))
    ended = run(tmp_path, "--drive", "modbus")
    ended.assert_ended(5, "another master changed a setting during the run", *words)
    standstill_s = ended.assert_stopped(acted[0], 2.0)
    seen(68, ended.message, standstill_s, ended.assert_log_whole(), 5)
