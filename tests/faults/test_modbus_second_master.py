"""Rows 70 on: other clients of a Modbus drive that read, command, or change its settings; judged on the shaft."""

import re
import struct
import subprocess
import sys

import pytest
from path_runs import REAL, Shaft, identify, process

from profiles.library import load_modbus_profile, profile_path
from sim_bus.modbus.embedded import EmbeddedModbusDrive
from sim_bus.params import RigParams

BY_NAME = "--accept-shared-watchdog"
RIG = (
    "limits: {speed_min_rad_s: 0.5, speed_max_rad_s: 10.0, torque_nm: 400.0, time_s: 900.0, quick_stop_rad_s2: 2.0,"
    " watchdog_s: 2.0, probe_torque_nm: 200.0, probe_travel_rad: 3.0}\n"
)
TURNING_RAD_S = 0.3


def fed_by(folder, what):
    """generic/modbus, but for what feeds its watchdog, as a file."""
    path = folder / "fed.yaml"
    path.write_text(profile_path("generic/modbus").read_text().replace("fed_by: writes", f"fed_by: {what}"))
    return path


@pytest.mark.parametrize(("what", "runs_on"), [
    ("any_request", True), ("requests_of_this_connection", False), ("writes", False), ("control_word", False),
    ("writes_of_this_connection", False),
])
def test_a_host_dies_while_another_client_reads(tmp_path, what, runs_on):
    """On the simulated drive itself: what the operator is asked about."""
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


def test_row_70_refused_unless_taken_by_name(tmp_path, no_bus_of_the_user, seen):
    """A real drive in a process of its own: nothing moves, and the way out is named."""
    profile, trace, rig = fed_by(tmp_path, "any_request"), tmp_path / "shaft.csv", tmp_path / "rig.yaml"
    rig.write_text(RIG)
    with process(
        sys.executable, *REAL, "modbus", "--tcp", "127.0.0.1:0", "--profile", profile, "--trace", trace,
        stdout=subprocess.PIPE,
    ) as drive:
        (port,) = re.findall(r"127\.0\.0\.1:(\d+)", drive.stdout.readline())
        line = ("--host", "127.0.0.1", "--port", port, "--profile", profile, "--rig", rig, "--rate", 4)
        refused = identify(tmp_path, *line, "--yes")
        taken = identify(tmp_path, *line, BY_NAME)         # and nobody at the terminal confirms
    assert refused.code == taken.code == 4
    message = refused.document["error"]["message"]
    assert "any request" in message and "will not stop by itself" in message and BY_NAME in message
    said = " ".join(taken.err.split())
    assert "no answer to a dead host" in said and "every other client of this drive is switched off" in said
    assert "nobody is there to confirm" in taken.document["error"]["message"]
    shaft = Shaft.read(trace)
    assert abs(shaft.speed_rad_s).max() < TURNING_RAD_S and "operation enabled" not in set(shaft.state)
    seen(70, message, None, "whole", 4)
