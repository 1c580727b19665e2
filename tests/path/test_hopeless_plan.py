"""Plans that no shaft could follow are refused before any access to the drive, with a specific message."""

import io

import pytest
from rich.console import Console

from drivers import PreflightRefused
from profiles import load_profile
from tdhil.cli.dry_run import say_before
from tdhil.cli.identify import show_settings
from tdhil.config.resolution import resolve
from tdhil.runner.excitation import PlanRefused
from tdhil.runner.planning import refuse_undersampled
from tdhil.runner.settings import ExcitationRequest
from tdhil.session import connection_of, plan_peer
from tdhil.session.dry_run import refuse_hopeless
from tests.path.path_runs import tdhil
from tests.rigs import STRING, limits_text, loaded_rig, rig_file
from tests.runner.line_drive import Line, LineDrive, run_line

QUICK = ("--seed", 1)
TORQUE, SPEED = load_profile("generic/cia402"), load_profile("danfoss/fc302")


@pytest.mark.long(but_first=6)
@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("arguments", "option"), [
    (("--max-time", 60), "--max-time 1"),
    (("--max-time", "1min", "--tolerance", "1%"), "--max-time 1"),
    (("--max-time", 60, "--mode", "speed"), "--max-time 1"),
    (("--max-time", 10, "--excitation", "pulses"), "--max-time"),
    (("--max-time", 5, "--excitation", "sine", "--frequency", 0.1), "--max-time"),
    (("--periods", 1), "--periods 2"),
    (("--excitation", "coast-down", "--frequency", 0.1), "--frequency"),
    (("--amplitude", 9), "--amplitude"),
    (("--offset", 9.99), "--offset"),
    (("--drive", "modbus", "--max-time", 60), "--max-time"),
    (("--frequency", 1000), "--frequency below 13.9 Hz"),
    (("--rate", 20, "--frequency", 3), "--frequency below 1.11 Hz"),
    (("--excitation", "sine", "--frequency", 500), "--frequency below 41.7 Hz"),
    (("--drive", "modbus", "--frequency", 20), "--frequency below"),
    (("--amplitude", 1e-6), "--amplitude"),
])
def test_a_run_refuses_at_once_the_plans_that_a_dry_run_refuses(tmp_path, monkeypatch, arguments, option):
    monkeypatch.chdir(tmp_path)
    runs = [tdhil("identify", *more, "--simulate", *arguments) for more in (("--dry-run",), QUICK)]
    for done in runs:
        assert done.code == 4, done.err
        assert option in done.err
        assert "stage" not in done.err.replace("stage 5", "")
    assert not list(tmp_path.glob("*.mcap"))


def test_a_value_with_another_unit_is_shown_without_the_digits_of_its_conversion():
    given = {"amplitude_rad_s": 9.94837673636768, "simulate": True}
    options, connection = connection_of(given, None, resolve(given, None))
    console = Console(file=io.StringIO(), width=80)
    show_settings(console, options, connection, plan_peer(options, connection))
    assert "9.94838  (" in console.file.getvalue()


def test_a_frequency_below_the_limit_has_no_aliasing():
    """The refusals before and after motion use one rule: just below the limit, the samples contain the lines."""
    refuse_undersampled(ExcitationRequest("sine", frequency_hz=16.6), 100.0)
    with pytest.raises(PlanRefused, match=r"45 Hz.*below 45 Hz"):
        refuse_undersampled(ExcitationRequest("sine", frequency_hz=45.0), 100.0)


def test_a_rate_that_turns_out_lower_is_refused_before_motion():
    """The line of the drive may be slower than in the profile. Preflight finds this before motion."""
    drive = LineDrive(Line(period_s=0.1))
    outcome = run_line(drive, ExcitationRequest("sine", frequency_hz=5.0)).outcome
    assert isinstance(outcome.cause, PreflightRefused)
    assert "aliasing" in str(outcome.cause)
    assert outcome.stop is None


def test_a_tone_runs_with_a_notice_that_no_interval_is_expected():
    options = resolve({"excitation": "sine", "frequency_hz": 1.0}, None)
    said = say_before(options, None, load_profile("generic/cia402"), True)
    assert said is not None
    assert "no interval of J is expected" in said


@pytest.mark.parametrize("arguments", [
    {}, {"max_time_s": 150.0}, {"tolerance": 0.01}, {"tolerance": 0.01, "max_time_s": 150.0},
    {"excitation": "coast-down"}, {"excitation": "pulses", "mode": "speed"},
    {"excitation": "sine", "frequency_hz": 1.0},
    {"amplitude_rad_s": 1.0, "offset_rad_s": 4.0}, {"excitation": "step", "periods": 3}, {"rate_hz": 20.0},
])
def test_possible_plans_are_not_refused(arguments):
    refuse_hopeless(resolve(arguments, None), None, TORQUE)
    if arguments.get("excitation") != "coast-down":
        refuse_hopeless(resolve(arguments, None), None, SPEED)


def test_a_plan_that_depends_on_the_shaft_is_left_to_the_run(tmp_path):
    """The assumed shaft is too heavy for this amplitude, but the true one may be lighter."""
    rig = loaded_rig(tmp_path, limits_text(watchdog_s=None), "expected: {inertia_kg_m2: 2000}\n")
    options = resolve({"amplitude_rad_s": 1.0, "excitation": "sine", "frequency_hz": 0.5}, rig)
    refuse_hopeless(options, rig, TORQUE)


@pytest.mark.parametrize(("profile", "lets_go"), [
    ("siemens/s120-canopen", True), ("siemens/g130-s120", True), ("generic/cia402", False), ("generic/modbus", False),
])
def test_a_dry_run_refuses_a_quick_stop_that_releases_a_string(tmp_path, profile, lets_go):
    """The profile shows it, and the run itself refuses it in preflight."""
    rig = rig_file(tmp_path, STRING, limits_text(watchdog_s=None), name="string.yaml")
    done = tdhil("identify", "--dry-run", "--simulate", "--rig", rig, "--profile", profile,
                 "--excitation", "sine", "--frequency", 0.5)
    assert done.code == (4 if lets_go else 0), done.err
    assert ("is disabled after a quick stop and would release it" in done.err) == lets_go
    assert ("quick_stop of the profile" in done.err) == lets_go
    coasting = tdhil("identify", "--dry-run", "--simulate", "--rig", rig, "--profile", profile,
                     "--excitation", "coast-down")
    assert coasting.code == 4
    assert "coast-down is not possible with a drill string on the shaft" in coasting.err
