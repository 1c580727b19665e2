"""End-to-end rehearsal of `tdhil identify --drive modbus --simulate --fault …`, and `simulate modbus --fault …`.

`test_modbus_rows` checks the reaction to each row with faults of the test itself. Here the same faults come from
the command line.
"""

from functools import partial

import pytest

from sim_bus.modbus.faults import KINDS, ONLY_ON
from tests.faults import rehearsal
from tests.faults.rehearsal import IN_MOTION
from tests.path.path_runs import host, modbus_peer, tdhil, wait_for
from tests.rigs import PATIENT_LIMITS, limits_text, rig_file

NOTICED_S = 0.6                # half the watchdog's time, or all of it, and five cycles


Case = partial(rehearsal.Case, notice_s=NOTICED_S)
CASES = (
    Case(19, "frozen-feedback@acquire+2s", 8, ("frozen", "gateway"), notice_s=2.0),
    Case(23, "drive-fault@torque+3s", 6, ("fault", "--reset-fault")),
    Case(30, "fault-at-start", 4, ("fault", "--reset-fault"), "refused"),
    Case(31, "stuck-state@setup", 6, ("was not enabled within 3 s",), "refused"),
    Case(32, "mode-not-followed@torque", 6, ("torque mode", "--mode speed")),
    Case(33, "sto" + IN_MOTION, 6, ("STO",), "coasts"),
    Case(33, "internal-limit@torque+3s", 7, ("internal limit",), notice_s=4.5),
    # Without load the shaft is light: once disabled, the random torque of the bearings moves it for a second.
    Case(34, "load-lost@torque+3s", 7, ("the speed changes faster than this shaft",), notice_s=2.0, free_rad_s=0.2),
    Case(35, "hot" + IN_MOTION, 7, ("too hot", "motor temperature: 150 °C", "limit of 110 °C"), notice_s=3.0),
    Case(35, "torque-scale" + IN_MOTION + "=5", 7, ("above the limit of 400 N·m",)),
    Case(36, "encoder-inverted", 4, ("turned backwards", "encoder wiring"), notice_s=7.0),
    Case(38, "exception" + IN_MOTION + "=2/100ms", 6, ("exception 2", "address")),
    Case(39, "no-reply" + IN_MOTION, 8, ("no good reply", "watchdog")),
    Case(40, "late-reply@acquire+2s", 8, ("no good reply", "watchdog")),
    Case(42, "short-reply@hold+2s", 8, ("watchdog",)),
    Case(42, "bad-crc" + IN_MOTION, 8, ("no good reply", "watchdog")),
    Case(44, "word-order", 4, ("register 42", "12345678h"), "refused"),
    Case(45, "reads-back-otherwise", 4, ("register 38", "required 0.4"), "refused"),
    Case(50, "watchdog-not-armed", 4, ("register 40", "required 0.5 s, found 0 s"), "refused"),
    Case(115, "sensor-lost" + IN_MOTION, 8, ("contradict each other", "encoder"), "coasts"),
    Case(116, "speed-frozen@acquire+2s", 8, ("contradict each other", "encoder"), notice_s=7.0),
    Case(118, "torque-scale=0.5", 6, ("contradicts the commanded torque",), notice_s=60.0),
    Case(120, "feedback-zero" + IN_MOTION, 8, ("no valid state",)),
    Case(120, "feedback-ones" + IN_MOTION, 8, ("no valid state",)),
)


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_row(case, rehearse, tmp_path):
    rig = rig_file(tmp_path, limits_text(temperature_c=110.0))
    run = rehearse("--drive", "modbus", "--fault", case.fault, "--rig", rig)
    run.assert_as(case)
    assert f"scripted fault {case.fault}" in " ".join(run.done.err.split())
    run.assert_log_whole()


@pytest.mark.heavy
def test_replies_that_are_lost_occasionally(rehearse):
    """With a seed and stepped time, the run continues, and a second run is identical."""
    first, second = (rehearse("--drive", "modbus", "--fault", "bad-crc@speed+15s=20%/2s") for _ in range(2))
    assert first.done.code in (0, 9), first.done.err
    assert {outcome for _, outcome in first.done.outcomes} <= {"ok", "degraded"}
    assert (first.shaft.speed_rad_s == second.shaft.speed_rad_s).all()
    first.shaft.assert_at_rest()


@pytest.mark.parametrize("name", ["reset", "half-open", "wrong-transaction-id"])
def test_what_only_tcp_has_is_refused_here(name, no_bus_of_the_user):
    done = tdhil("identify", "--simulate", "--drive", "modbus", "--fault", name)
    assert done.code == 2
    assert "simulate modbus --tcp" in " ".join(done.err.split())
    assert "tcp" in ONLY_ON[name]


def test_the_list_names_those_of_both_buses():
    done = tdhil("identify", "--fault", "list")
    assert done.code == 0
    assert all(name in done.out for name in (*KINDS, "heartbeat-lost", "--drive canopen", "--drive modbus"))


def test_the_list_of_one_bus_is_shorter():
    done = tdhil("identify", "--drive", "modbus", "--fault", "list")
    assert done.code == 0 and "bad-crc" in done.out
    assert "heartbeat-lost" not in done.out and "--drive canopen" not in done.out


@pytest.mark.heavy
@pytest.mark.real_time
def test_a_connection_that_is_reset_in_motion(tmp_path):
    """Row 43 with the drive in its own process, in real time. The trace is in plant time."""
    rig = rig_file(tmp_path, PATIENT_LIMITS)
    with (modbus_peer(tmp_path / "shaft.csv", "--fault", "reset@speed+2s") as drive,
          host(tmp_path, *drive.options, "--rate", 4, "--rig", rig, cwd=tmp_path) as running):
        done = running.finish()

        def resting():
            shaft = drive.shaft
            return shaft.time_s[-1] > shaft.at_rest_from() + 1.0

        wait_for("the shaft to come to rest", resting)
        shaft = drive.shaft
    assert done.code == 8, done.err           # it cannot confirm standstill
    assert "connection" in done.document["error"]["message"] and "Traceback" not in done.err
    (at_s,) = shaft.events("fault: ")
    assert shaft.speed_at(at_s) > 0.1
    assert shaft.events("host silent")[0] > at_s and not shaft.events("host is back")
    shaft.assert_never_let_go()
