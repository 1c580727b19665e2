"""`tdhil identify --drive modbus`: the whole path on the embedded simulator, and usage errors."""

import os
import sys
import termios
from types import SimpleNamespace

import pytest

from profiles.library import load_modbus_profile, load_profile, profile_path
from tdhil.recording.log_reader import read_frames, read_run
from tests.path.path_runs import QUICK, TOO_MUCH, identify, modbus_peer, tdhil
from tests.rigs import limits_text, rig_file

pytestmark = pytest.mark.one_worker

WRITING = {5, 6, 15, 16, 22, 23}
"""Function codes that write (Modbus Application Protocol V1.1b3, section 6)."""
RIG = "modbus: {unit: 1}\n" + limits_text(watchdog_s=2.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return identify(tmp_path_factory.mktemp("modbus"), "--drive", "modbus", "--simulate", *QUICK, "--seed", 1,
                    "--periods", 4)


def test_the_inertia_of_the_simulated_rig(run):
    assert run.code == 0, run.err
    document = run.document
    inertia = document["inertia_kg_m2"]
    assert document["verdict"] == "valid"
    assert inertia["value"] == pytest.approx(104.0, rel=0.02)
    assert inertia["low"] < 104.0 < inertia["high"]
    assert document["simulated"] is True
    assert run.outcomes == [(name, "ok") for name in ("setup", "speed", "torque", "hold", "acquire")]
    assert "SIMULATED: embedded Modbus drive and rig (as requested), stepped time, seed 1" in run.err


@pytest.mark.heavy
def test_its_replay_is_identical(run):
    again = tdhil("replay", "--json", run.log)
    assert again.code == 0, again.err
    assert again.document | {"log": ""} == run.document | {"log": ""}
    assert "SIMULATED" in tdhil("replay", run.log).out


def test_the_log_contains_the_connection_to_the_drive(run):
    configuration = read_run(run.log).configuration
    assert configuration["drive"] == "modbus"
    assert configuration["bus"] == {"unit": {"value": "1", "source": "profile generic/modbus"}}
    assert configuration["profile"]["name"] == "generic/modbus"
    assert configuration["options"]["profile"] == {"value": "generic/modbus", "source": "default"}
    frames = list(read_frames(run.log))
    assert {frame.identifier for frame in frames} == {1}
    assert {True, False} == {frame.outgoing for frame in frames}


@pytest.mark.heavy
def test_a_seed_repeats_it(tmp_path):
    runs = [identify(tmp_path, "--profile", "generic/modbus", *QUICK, *TOO_MUCH, "--seed", 3, log=name)
            for name in ("a.mcap", "b.mcap")]
    for done in runs:
        assert done.code == 7                                  # it reached the plan, which does not fit
        assert "amplitude of 3 rad/s" in done.err
        assert "no Modbus host and no serial device is named" in done.err.replace("\n", " ")
    assert list(read_frames(runs[0].log)) == list(read_frames(runs[1].log))


@pytest.mark.heavy
def test_the_unit_is_the_requested_one(tmp_path):
    done = identify(tmp_path, "--drive", "modbus", "--simulate", "--unit", 17, *QUICK, *TOO_MUCH)
    assert done.code == 7
    assert {frame.identifier for frame in read_frames(done.log)} == {17}


def test_a_dry_run_uses_the_profile_of_the_drive(tmp_path):
    plain = ("--excitation", "sine", "--frequency", 0.5)          # quick to plan
    done = tdhil("identify", "--drive", "modbus", "--simulate", "--dry-run", "--json", *plain)
    assert done.code == 0, done.err
    assert done.document["mode"] == "torque"
    options = ("--profile", "schneider/atv320", "--simulate", "--dry-run", "--json", *plain)
    assert tdhil("identify", *options).document["mode"] == "speed"       # that drive has no torque mode
    refused = tdhil("identify", *options, "--mode", "torque")
    assert refused.code == 4
    assert "--mode speed" in refused.err


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "bus"), [("maxon/epos4", "canopen"), ("siemens/g130-s120", "modbus")])
def test_the_simulator_uses_the_profile(tmp_path, name, bus):
    profile = load_profile(name)
    done = identify(tmp_path, "--profile", name, "--simulate", *QUICK, *TOO_MUCH)
    assert "SIMULATED" in done.err
    assert f"drive          {bus}  (profile {name})" in done.err
    configuration = read_run(done.log).configuration
    assert configuration["profile"]["name"] == name
    assert configuration["identity"]["simulated"] is True
    if bus == "canopen":
        assert configuration["identity"]["vendor"] == profile.identity.vendor
    assert done.outcomes[0] == ("setup", "ok")
    doubts = len(profile.below("likely")) + len(profile.below("unverified"))
    assert f"profile {name}: {doubts} entries are not verified" in done.err


# -- missing or unusable connections --------------------------------------------------------------------


def test_nobody_listens_there(tmp_path):
    done = identify(tmp_path, "--host", "127.0.0.1", "--port", 1)
    assert done.code in (4, 5)
    assert "127.0.0.1:1" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(("number", "said"), [(2, "the device does not exist"), (13, "sudo "), (16, "another program")])
@pytest.mark.parametrize("command", ["identify", "scan", "doctor"])
def test_a_serial_device_that_can_not_be_opened(monkeypatch, command, number, said):
    def refuse(*arguments, **options):
        raise OSError(number, os.strerror(number), "/dev/ttyUSB9")

    monkeypatch.setitem(sys.modules, "serial", SimpleNamespace(Serial=refuse))
    done = tdhil(command, "--serial", "/dev/ttyUSB9")
    assert done.code == 4
    (line,) = [line for line in (done.err + done.out).splitlines() if "/dev/ttyUSB9: can't open" in line]
    assert said in done.err + done.out, line
    assert "Traceback" not in done.err


@pytest.mark.parametrize("command", ["identify", "scan", "doctor"])
def test_a_serial_device_that_refuses_its_settings(monkeypatch, command):
    def refuse(*arguments, **options):
        raise termios.error(22, "Invalid argument")               # no OSError; a pseudo terminal refuses parity so

    monkeypatch.setitem(sys.modules, "serial", SimpleNamespace(Serial=refuse))
    done = tdhil(command, "--serial", "/dev/ttyUSB9")
    assert done.code == 4
    assert "/dev/ttyUSB9: the device refuses" in done.err + done.out
    assert "--parity" in done.err + done.out
    assert "Traceback" not in done.err


@pytest.mark.heavy
def test_a_drive_in_another_process_over_tcp(tmp_path):
    with modbus_peer(tmp_path / "shaft.csv", "--unit", 3) as drive:
        scanned = tdhil("scan", *drive.options, "--units", "2-3", "--json")
        looked = tdhil("doctor", *drive.options, "--unit", 3)
        nobody = tdhil("scan", *drive.options, "--units", "9")
        profile = tdhil("doctor", *drive.options, "--unit", 3, "--profile", "siemens/g130-s120")
    (found,) = scanned.document["found"]
    assert (found["address"], found["simulated"], found["profile"]) == (3, True, "generic/modbus")
    assert found["line"] == {"host": "127.0.0.1", "port": int(drive.port)}
    assert looked.code == 0, looked.out
    assert "305419896" in looked.out
    assert nobody.code == 5
    assert "units 9" in nobody.err
    assert profile.code == 4                                       # not its profile, and the message states it
    assert "can't be read" in profile.out


# -- a drive that is treated as a real one --------------------------------------------------------------------


@pytest.fixture
def real(monkeypatch, tmp_path):
    """Return the embedded drive without the simulator's marker, in real time, with unverified profile entries."""
    from sim_bus.modbus import registers

    monkeypatch.setattr(registers, "MARKER_TEXT", "somebody's drive")
    text = profile_path("generic/modbus").read_text(encoding="utf-8")
    text = text.replace("confidence: verified", "confidence: likely", 1)                     # line
    text = text.replace("name: check_sign", "name: sign_check", 1)
    head, tail = text.split("watchdog:\n", 1)
    path = tmp_path / "mine.yaml"
    path.write_text(head + "watchdog:\n" + tail.replace("\n  confidence: verified", "\n  confidence: unverified", 1),
                    encoding="utf-8")
    assert load_modbus_profile(str(path)).below("unverified") == ("watchdog",)
    rig = rig_file(tmp_path, "name: bench 3\n", RIG)
    return "--profile", path, "--rig", rig, "--simulate", "--real-time"


def test_unverified_entries_are_refused_without_any_write(tmp_path, real):
    for named in ((), ("--accept-unverified", "likely"), ("--accept-unverified", "watchdog")):
        done = identify(tmp_path, *real, "--yes", *named)
        assert done.code == 4
        assert done.document["error"]["kind"] == "PreflightRefused"
        assert "nothing has moved" in done.err
        assert ("line (likely)" in done.err) == ("likely" not in named)
        assert ("watchdog (unverified)" in done.err) == ("watchdog" not in named)
        written = [frame for frame in read_frames(done.log) if frame.outgoing and frame.data[0] in WRITING]
        assert written == []


@pytest.mark.heavy
def test_the_prompt_names_the_overrides(tmp_path, real):
    done = identify(tmp_path, *real, "--accept-unverified", "likely", "--accept-unverified", "watchdog")
    assert done.code == 4
    assert "no operator can confirm" in done.err
    assert "although unverified" in done.err
    assert "watchdog (unverified): this project's own map" in done.err
    kept = read_run(done.log).configuration["unverified"]
    assert [line.split(":")[0] for line in kept] == ["line (likely)", "watchdog (unverified)"]


def test_without_a_rig_name_no_real_drive_moves(tmp_path, real):
    """A result without a rig has no history. The simulated rig needs no name."""
    rig_file(tmp_path, RIG)
    done = identify(tmp_path, *real, "--yes", "--accept-unverified", "likely", "--accept-unverified", "watchdog")
    assert (done.code, done.document["error"]["code"]) == (4, "TDH-440")
    assert "name: bench 3" in done.err and "nothing has moved" in done.err
    assert [frame for frame in read_frames(done.log) if frame.outgoing and frame.data[0] in WRITING] == []


def test_without_limits_there_is_no_motion(tmp_path, real):
    done = identify(tmp_path, *real[:2], *real[4:], "--yes")
    assert done.code == 4
    assert "no machine limits" in done.err
