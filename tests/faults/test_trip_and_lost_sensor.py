"""Drive that trips while its speed signal is lost: the lag of the report hides the motion of the shaft."""

import numpy as np
import pytest

from sim_bus.shaft_judge import outcome_of
from tdhil.errors import ExitCode

FASTEST_AT_REST_RAD_S = 0.2


def speed_when_seen(run):
    """Return the true speed at the time of the reported standstill, or None if none was reported."""
    seen_s = outcome_of(run.done.code, run.done.document, run.done.err, log_closed=True).seen_s
    return None if seen_s is None else abs(float(np.interp(seen_s, run.shaft.time_s, run.shaft.speed_rad_s)))


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("drive", "trip"), [
    ("modbus", "drive-fault"), ("canopen", "sto"), ("canopen", "drive-fault"), ("modbus", "sto"),
])
def test_before_j_is_known_it_confirms_nothing(drive, trip, rehearse):
    """The report falls to zero in 1.5 s, as a light shaft would. The true shaft turns for 3 to 8 s."""
    run = rehearse("--drive", drive, "--fault", f"{trip}@speed+2s", "--fault", "sensor-lost@speed+2s")
    assert run.done.code == ExitCode.STOP_NOT_CONFIRMED, run.done.err
    assert speed_when_seen(run) is None


@pytest.mark.heavy
def test_once_j_is_known_it_waits_for_the_longest_coasting_time(rehearse):
    run = rehearse("--fault", "sto@torque+2s", "--fault", "sensor-lost@torque+2s")
    assert run.done.code == ExitCode.DRIVE_FAULT
    assert speed_when_seen(run) < FASTEST_AT_REST_RAD_S


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("drive", "fault"), [
    ("modbus", "drive-fault@speed+1s"), ("canopen", "drive-fault@speed+1s"), ("canopen", "sto@speed+2s"),
    ("modbus", "sto@speed+1s"), ("canopen", "drive-fault@torque+1s"),
])
def test_a_trip_with_a_sound_sensor_is_confirmed(drive, fault, rehearse):
    run = rehearse("--drive", drive, "--fault", fault)
    assert run.done.code == ExitCode.DRIVE_FAULT, run.done.err
    assert speed_when_seen(run) < FASTEST_AT_REST_RAD_S
