"""Drive that differs from its profile, on the whole path: errors that are refused before motion, and others.

Scale and sign of a register can only be checked with a second register, an echo or a name plate. A real drive with an
unchecked setpoint is refused without an override (``echoes.speed``). The next check is then the sign probe, forward at
low speed. For a value that is read without a sign it is the braking probe, at low speed before torque mode continues.
"""

from functools import partial

import numpy as np
import pytest

from drivers.errors import PreflightRefused
from profiles.library import load_modbus_profile, load_profile, profile_names
from profiles.modbus import ModbusProfile
from sim_bus.modbus import embedded, registers
from sim_bus.modbus.wrong_maps import parse
from tdhil.recording.log_reader import read_frames
from tdhil.session.overrides import accepted_lines, require_accepted
from tests.path.path_runs import Shaft, identify
from tests.rigs import DRIVE_LIMITS, limits_text, rig_file

NAMES = [name for name in profile_names() if isinstance(load_profile(name), ModbusProfile)]
WRONGS = ("word_order", "scale_10", "address_off_by_one", "sign", "unsigned", "write_not_applied")

ONE_REGISTER = "all of its numbers take one register each: there is no order that could be wrong"
NO_TWIN = "the documents at hand name no register in which the setpoint shows before the ramp lets it through"
NO_SIGN = "nothing that it has or shows at rest is below zero: the speed words have no sign, the direction is a bit"
NO_SIGNED_TWIN = "its speed words have no sign, and nothing shows a torque setpoint before the drive regulates torque"
"""Reason for profiles other than delta/ms300, which has no torque setpoint: there only a report could lack the sign."""

PLAIN_16 = ("delta/ms300", "lenze/i550", "schneider/atv320", "schneider/atv340-930", "siemens/g120",
            "siemens/g130-s120", "yaskawa/ga700")
UNTOLD = {
    **{(name, "word_order"): ONE_REGISTER for name in PLAIN_16},
    ("lenze/i550", "scale_10"): NO_TWIN,
    **{(name, "sign"): NO_SIGN for name in ("delta/ms300", "yaskawa/ga700")},
    ("lenze/i550", "unsigned"): NO_TWIN,
    **{(name, "unsigned"): NO_SIGNED_TWIN for name in ("delta/ms300", "yaskawa/ga700")},
}
CAUGHT = [(name, wrong) for name in NAMES for wrong in WRONGS if (name, wrong) not in UNTOLD]

ALWAYS = ("generic/modbus", "abb/acs880-classic")


def some_always(cases):
    """Mark the cases: those of two profiles in every run, those of the others with --long."""
    return [pytest.param(*case, marks=() if case[0] in ALWAYS else pytest.mark.long) for case in cases]


def wired(monkeypatch, *wrongs):
    drive = partial(embedded.EmbeddedModbusDrive, wrongs=tuple(map(parse, wrongs)))
    monkeypatch.setattr(embedded, "EmbeddedModbusDrive", drive)


def ran(tmp_path, name):
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", "--profile", name, "--seed", 1, "--trace", trace)
    return done, Shaft.read(trace)


@pytest.mark.heavy(but_first=4)
@pytest.mark.parametrize(("name", "wrong"), some_always(CAUGHT))
def test_refused_before_the_shaft_moves(name, wrong, monkeypatch, tmp_path):
    wired(monkeypatch, wrong)
    done, shaft = ran(tmp_path, name)
    assert done.code == 4, done.err
    assert done.document["error"]["message"].count(". ") >= 1       # and the next step
    assert "Traceback" not in done.err
    assert np.max(np.abs(shaft.speed_rad_s)) < 0.001
    shaft.assert_enabled(False)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, wrong in UNTOLD if wrong == "sign"])
def test_a_sign_that_no_register_shows_ends_in_the_sign_probe(name, monkeypatch, tmp_path):
    wired(monkeypatch, "sign")
    done, shaft = ran(tmp_path, name)
    assert done.code == 4, done.err
    assert "sign probe: the shaft turned backwards" in done.document["error"]["message"]
    assert np.max(np.abs(shaft.speed_rad_s)) < 1.0
    assert np.trapezoid(np.abs(shaft.speed_rad_s), shaft.time_s) < 3.0       # rad: the probe's travel
    shaft.assert_at_rest()


SEEMS_TO_ACCELERATE = {"yaskawa/ga700"}
"""Drives whose unsigned torque report looks like a quick stop that accelerates.

tdhil removes the torque, and the stop is not confirmed. This is the rule without a drill string
(docs/explanation/stop.md).
"""


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, wrong in UNTOLD if wrong == "unsigned"])
def test_a_missing_sign_that_no_register_shows_ends_in_the_braking_probe(name, monkeypatch, tmp_path):
    """Drives without a torque mode have no torque setpoint; for all others see test_braking_probe.

    The shaft slows down with a torque that is reported as positive, which is a contradiction.
"""
    wired(monkeypatch, "unsigned")
    done, shaft = ran(tmp_path, name)
    if load_modbus_profile(name).modes.torque:
        assert done.code == (8 if name in SEEMS_TO_ACCELERATE else 4), done.err
        assert "braking probe, register" in done.document["error"]["message"]
        assert np.max(shaft.speed_rad_s) < 7.5          # stage 2, in speed mode; the limit is 10
    else:
        assert done.code == 8, done.err      # this torque confirms no standstill either
        assert "reported speed and torque contradict each other" in done.document["error"]["message"]
        assert np.max(shaft.speed_rad_s) < 10.0
    shaft.assert_at_rest()


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, wrong in UNTOLD if wrong == "scale_10"])
def test_a_scale_that_no_register_shows_gives_no_number(name, monkeypatch, tmp_path):
    """With tenfold counts, a command is a tenth of the intended value, so the shaft is slower, never faster."""
    wired(monkeypatch, "scale_10")
    done, shaft = ran(tmp_path, name)
    assert done.code in (4, 6, 7, 8), done.err
    assert "Traceback" not in done.err
    assert np.max(np.abs(shaft.speed_rad_s)) < 1.0
    assert np.max(np.abs(shaft.speed_rad_s[-100:])) < 0.001


@pytest.mark.parametrize("name", some_always((name,) for name in NAMES))
def test_preflight_notes_unchecked_registers(name, monkeypatch, tmp_path):
    from tests.drivers.modbus_bench import driven

    profile = load_modbus_profile(name)
    peer = embedded.EmbeddedModbusDrive(embedded.RigParams(), profile)
    drive = driven(peer, profile)
    drive.connect()
    found = drive.preflight(DRIVE_LIMITS)
    assert found.refused == ()
    notes = [check.name for check in found.checks if "in motion only" in check.found]
    assert notes == [f"{name} setpoint as received by the drive" for name in unseen(profile)]


def unseen(profile):
    setpoints = {"speed", "torque"} if profile.modes.torque else {"speed"}
    return sorted(setpoints - {echo.setpoint for echo in profile.echoes})


@pytest.mark.parametrize("name", [name for name in NAMES if unseen(load_modbus_profile(name))])
def test_a_real_drive_with_an_unchecked_setpoint_is_refused_without_an_override(name):
    profile = load_modbus_profile(name)
    asked = {f"echoes.{setpoint}" for setpoint in unseen(profile)}
    others = {"likely", "echoes", *profile.below("unverified")} - asked
    with pytest.raises(PreflightRefused) as refused:
        require_accepted(profile, others)
    lines = [line.split()[0] for line in refused.value.what.split("\n") if line.startswith("  ")]
    assert set(lines) == asked
    assert all(f"--accept-unverified {one}" in str(refused.value) for one in asked)
    require_accepted(profile, others | asked)
    assert asked <= {line.split()[0] for line in accepted_lines(profile, others | asked)}     # named in the prompt


@pytest.mark.parametrize(("name", "wrong"), [
    (name, wrong) for name, wrong in UNTOLD if wrong != "word_order" and unseen(load_modbus_profile(name))
])
def test_no_error_of_an_unchecked_setpoint_moves_a_real_shaft_without_an_override(name, wrong, monkeypatch, tmp_path):
    wired(monkeypatch, wrong)
    monkeypatch.setattr(registers, "MARKER_TEXT", "somebody's drive")         # treated as a real one
    profile, trace = load_modbus_profile(name), tmp_path / "shaft.csv"
    asked = {f"echoes.{setpoint}" for setpoint in unseen(profile)}
    others = {"likely", *profile.below("unverified")} - asked
    rig = rig_file(tmp_path, "name: bench 3\n", limits_text(probe_torque_nm=150.0, watchdog_s=None))
    done = identify(tmp_path, "--simulate", "--real-time", "--yes", "--profile", name, "--trace", trace, "--rig", rig,
                    *(f"--accept-unverified={one}" for one in others))
    assert done.code == 4, done.err
    assert all(f"{one} (unverified): no register shows" in done.err for one in asked), done.err
    assert not any(frame.outgoing and frame.data[0] in (5, 6, 15, 16, 22, 23) for frame in read_frames(done.log))
    Shaft.read(trace).assert_enabled(False)


def test_each_motion_before_a_check_has_an_override():
    """The exception is the sign of a report, which is zero at standstill."""
    left = {(name, wrong) for name, wrong in UNTOLD if wrong != "word_order"}
    taken = {(name, wrong) for name, wrong in left if unseen(load_modbus_profile(name))}
    assert left - taken == {("delta/ms300", "sign"), ("delta/ms300", "unsigned")}
