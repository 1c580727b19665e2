"""Stage 5 with a virtual string on the fake drive: earlier stages, reasons of its end, and removal of the string."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from drivers.drive import Mode
from drivers.errors import CommunicationLost, DriveFault, LimitHit, PreflightRefused, ReportsContradict
from tdhil.runner.five_stages import Runner
from tdhil.runner.settings import ExcitationRequest
from tdhil.runner.task import Task
from tdhil.soft_torque import (
    COLUMNS,
    RPM,
    EvaluationOutcome,
    EvaluationRefused,
    HostLoop,
    IdentifiedRig,
    Phase,
    SpeedProgram,
    evaluate,
)
from tests.runner.fake_drive import LIMITS, FakeDrive, FakeLog
from tests.runner.run_outcomes import assert_at_rest, outcomes, up_to
from tests.soft_torque.test_evaluation import CASE

ROOM = replace(LIMITS, torque_nm=1000.0, speed_max_rad_s=15.0, time_s=2000.0)
BENCH = replace(CASE, rig=IdentifiedRig(100.0, 8.0, 60.0, 0.02))      # FakeDrive reports at once


class RowsLog(FakeLog):
    def __init__(self):
        super().__init__()
        self.rows = []

    def virtual(self, row):
        self.rows.append(row)


@pytest.fixture
def course(monkeypatch):
    """Replace the planned course by a fixed one, since planning simulates for a second."""
    laid = SpeedProgram(45.0 * RPM, 79.0 * RPM, peak_nm=7000.0)
    monkeypatch.setattr("tdhil.runner.stages.virtual_string.program_for", lambda case, window: laid)


def runner(here, case=BENCH, limits=ROOM):
    here.log = RowsLog()
    task = Task(limits, ExcitationRequest(mode="torque"), {}, case=case)
    return Runner(here.drive, lambda _: task, here.log, here.stop_request, here.display, lambda *_: None)


def until(here, cycle, what):
    """Apply the fault ``what`` to the drive from that cycle of stage 5 on."""

    def look(stage, seen):
        if stage == "acquire" and seen == cycle:
            what()

    here.display.on_cycle = look


def rows_of(here):
    return dict(zip(COLUMNS, np.array(here.log.rows).T, strict=True))


def stopped(here, result):
    """Assert a confirmed stop: no torque command after the last cycle of the stage, and no reverse rotation."""
    assert_at_rest(here, result)
    assert outcomes(result) == up_to("acquire")
    at = here.drive.calls.index("quick_stop")
    cycles = here.drive.calls[:at].count("exchange")
    assert all(one.torque_nm == 0.0 and one.mode is Mode.SPEED for one in here.drive.commands[cycles:])


@pytest.mark.heavy
def test_ctrl_c_while_the_bit_sticks_takes_the_string_away_first(world, course):
    here = world(FakeDrive(), ROOM)
    speeds = []
    until(here, 1500, here.stop_request.ask)
    here.display.on_started = lambda name: speeds.clear()
    move = here.drive._move
    here.drive._move = lambda command: (move(command), speeds.append(here.drive.speed))[0]
    result = runner(here).run()
    stopped(here, result)
    rows = rows_of(here)
    assert rows["phase"].max() == Phase.RAMP and (rows["bit_rad_s"][-700:] == 0.0).any()
    assert np.ptp(rows["top_rad_s"][-700:]) > 2.0      # stick-slip
    assert min(speeds) >= 0.0
    assert here.log.run["evaluation"]["program"]["start_rad_s"] > 0.0


def powerless(drive, sample):
    drive.coulomb, drive.viscous, drive.inertia = 0.0, 0.0, 1e9
    return sample


def frozen(first):
    def misbehave(drive, sample):
        first.append(sample)
        return sample._replace(speed_rad_s=first[0].speed_rad_s, torque_nm=first[0].torque_nm)

    return misbehave


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("name", "cause", "said"), [
    ("powerless", ReportsContradict, "does not do what the torque accounts for|contradict each other"),
    ("frozen", (ReportsContradict, CommunicationLost), "frozen|does not do"),
    ("deaf", CommunicationLost, "no feedback"),
    ("off", DriveFault, "left the state"),
])
def test_what_befalls_the_drive_ends_the_stage_and_the_shaft_comes_to_rest(world, course, name, cause, said):
    here = world(FakeDrive(), ROOM)

    def befall():
        if name == "powerless":
            keep = here.drive.inertia, here.drive.coulomb, here.drive.viscous
            here.drive.misbehave = powerless
            # the shaft follows the stop again
            here.drive.quick_stop_was = here.drive.quick_stop

            def quick_stop():
                here.drive.misbehave = None
                here.drive.inertia, here.drive.coulomb, here.drive.viscous = keep
                here.drive.quick_stop_was()

            here.drive.quick_stop = quick_stop
        elif name == "frozen":
            here.drive.misbehave = frozen([])
        elif name == "deaf":
            here.drive.misbehave = lambda drive, sample: sample._replace(fresh=False)
        else:
            here.drive.fault()

    until(here, 900, befall)
    result = runner(here).run()
    assert isinstance(result.cause, cause)
    assert re.search(said, str(result.cause))
    if name != "deaf":      # there is no feedback of this shaft: only its own watchdog remains
        assert here.drive.speed == pytest.approx(0.0, abs=1e-6)
    assert result.stop.confirmed is (name in ("powerless", "off"))
    assert outcomes(result) == up_to("acquire")


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize(("figure", "said"), [
    ("put_in_j", "the loop's errors have put 1000000 J"), ("net_nm", "the loop oscillates with"),
])
def test_energy_that_the_loop_puts_in_and_a_swing_beyond_string_and_bit_end_it(
    world, course, monkeypatch, figure, said
):
    here = world(FakeDrive(), ROOM)
    until(here, 900, lambda: monkeypatch.setattr(HostLoop, figure, property(lambda loop: 1e6)))
    result = runner(here).run()
    assert isinstance(result.cause, LimitHit) and re.search(said, str(result.cause))
    stopped(here, result)


@pytest.mark.parametrize(("case", "limits", "cause", "said"), [
    (replace(BENCH, rig=replace(BENCH.rig, speed_lag_s=0.7)), ROOM, EvaluationRefused, "lags by"),
    (BENCH, replace(ROOM, torque_nm=300.0), EvaluationRefused, "its limit"),
    (BENCH, replace(ROOM, time_s=400.0), PreflightRefused, "above the limit of 400 s"),
    (BENCH, replace(ROOM, load="string", torque_ramp_nm_s=50.0), PreflightRefused, "load is string"),
], ids=["lag", "torque", "time", "string"])
def test_what_can_not_be_is_refused_before_anything_moves(world, case, limits, cause, said):
    here = world(FakeDrive(), limits)
    result = runner(here, case, limits).run()
    assert isinstance(result.cause, cause) and said in str(result.cause)
    assert result.stop is None and here.drive.speed == 0.0


def test_a_result_of_another_rig_is_refused(world, course):
    here = world(FakeDrive(), ROOM)
    other = replace(BENCH, rig=replace(BENCH.rig, inertia_kg_m2=45.0))
    result = runner(here, other).run()
    assert isinstance(result.cause, PreflightRefused) and "this shaft has about" in str(result.cause)
    assert_at_rest(here, result)


@pytest.mark.heavy
def test_a_torque_limit_that_acts_fades_the_string_out_and_leaves_no_result(world, course):
    tight = replace(ROOM, torque_nm=350.0)
    here = world(FakeDrive(), tight)
    result = runner(here, BENCH, tight).run()
    assert result.cause is None
    assert [stage.outcome for stage in result.stages] == ["ok"] * 5
    assert_at_rest(here, result)
    rows = rows_of(here)
    assert rows["clamped"].any() and rows["phase"].max() == Phase.DONE
    first = int(np.flatnonzero(rows["clamped"])[0])
    assert np.all(np.diff(rows["share"][first:]) <= 0.0) and rows["share"][-1] == 0.0
    assert max(abs(one.torque_nm) for one in here.drive.commands) <= 350.0
    assert ("limits", "virtual string: the torque limit acts; it is faded out") in here.log.events
    found = evaluate(np.array(here.log.rows), BENCH, SpeedProgram(45.0 * RPM, 79.0 * RPM))
    assert found.outcome is EvaluationOutcome.INVALID and "torque limit" in found.why
