"""J during stage 5: computed at ends of periods only, without a delay of cycles, and equal to the final J."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.drive import Mode
from tdhil.estimation import Options, identify
from tdhil.recording import Excitation, LiveInertia, Segment
from tdhil.recording.builder import RecordingBuilder
from tdhil.runner import interim
from tdhil.runner.excitation import MotionLimits, PlanRequest, RigGuess, make_plan
from tdhil.runner.five_stages import Runner
from tdhil.runner.interim import CORE_SHARE, STEPPED_S, Answered, InertiaWatch, Interim, answer_with, identify_plainly
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest, StopRequest
from tdhil.runner.stages.acquire import run_acquire
from tdhil.runner.stages.hold import MeanSpeedControl
from tdhil.runner.task import Task
from tests.runner.fake_drive import FakeDisplay, FakeDrive
from tests.runner.line_drive import LIMITS, BuilderLog, Line, LineDrive

PLAN = make_plan(MotionLimits(0.5, 10.0, 400.0, 0.9), RigGuess(100.0, 8.0, 60.0), PlanRequest(periods=4))
MOTION = Excitation("multisine", "torque", (Segment(0.0, 40.0, 10.0, 1, 3.0, (0.1,), (1.0,), (0.0,)),))
FOUND = LiveInertia(1.0, 3, 0.95, "valid", "because", 104.0, 103.0, 105.0, 100.0, 108.0, 0.4)


class Viewer(FakeDisplay):
    """Display that can show J."""

    follows_inertia = True

    def __init__(self):
        super().__init__()
        self.answers = []

    def inertia(self, found):
        self.answers.append(found)


class Log(BuilderLog):
    """The part of a log that a watch uses."""

    def recording(self, *, complete):
        return None


class Worker:
    """Worker process that answers once ``go`` is set."""

    def __init__(self):
        self.go, self.asked = threading.Event(), []

    def ask(self, work):
        self.asked.append(work)
        self.go.wait(30.0)
        return Answered(FOUND, 0.2)


def watch_of(stepped, worker=None, viewer=None, **more):
    loop = SimpleNamespace(
        drive=SimpleNamespace(clock=SimpleNamespace(stepped=stepped)), period_s=0.01, worker_process=worker,
        now_s=10.0, compute_while=lambda work, cycle: work(),
    )
    log = Log()
    return InertiaWatch(loop, log, viewer or Viewer(), identify_plainly, 0.95, **more), loop, log


@pytest.fixture
def answered(monkeypatch):
    """Replace the computation and return the list of its requests."""
    asked = []

    def answer(recording, question):
        asked.append(question)
        return Answered(FOUND, 0.5)

    monkeypatch.setattr(interim, "interim_answer", answer)
    return asked


def test_without_a_viewer_nothing_is_computed(answered):
    watch, _, log = watch_of(True, viewer=FakeDisplay())
    watch.period_ended(MOTION, 5.0)
    closed = Viewer()
    closed.follows_inertia = False
    other, _, _ = watch_of(True, viewer=closed)
    other.period_ended(MOTION, 5.0)
    short, _, _ = watch_of(True)
    short.period_ended(replace(MOTION, segments=(replace(MOTION.segments[0], end_s=30.0),)), 5.0)     # too few periods
    assert answered == []
    assert log.inertias == []


def test_in_stepped_time_answers_come_by_control_time_alone(answered):
    viewer = Viewer()
    watch, loop, log = watch_of(True, viewer=viewer)
    for at_s in (10.0, 10.0 + 0.5 * STEPPED_S, 10.0 + STEPPED_S, 10.0 + 1.4 * STEPPED_S, 10.0 + 2.1 * STEPPED_S):
        loop.now_s = at_s
        watch.period_ended(MOTION, 5.0)
    assert len(answered) == len(viewer.answers) == len(log.inertias) == 3
    assert answered[0] == Interim(MOTION, identify_plainly, 0.95, 0.95, None, None)


def test_with_a_tolerance_it_shows_when_the_run_may_end_and_the_cost_of_interim_looks(answered):
    watch, _, _ = watch_of(True, working=lambda: 0.97, tolerance=0.01)
    watch.period_ended(MOTION, 5.0)
    assert answered == [Interim(MOTION, identify_plainly, 0.95, 0.97, 0.01, 5.0)]


def test_in_real_time_no_cycle_waits_and_the_computation_keeps_to_its_share_of_a_core(monkeypatch):
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(interim, "time", SimpleNamespace(monotonic=lambda: now.s))
    worker, viewer = Worker(), Viewer()
    watch, _, _ = watch_of(False, worker, viewer)
    watch.period_ended(MOTION, 5.0)
    watch.look()
    now.s += 60.0
    watch.period_ended(MOTION, 5.0)           # no second request before the first answer
    assert viewer.answers == []
    worker.go.set()
    pending = watch._pending
    assert pending.ended.wait(30.0)
    assert len(worker.asked) == 1
    watch.look()
    assert viewer.answers == [FOUND]
    now.s = 100.0 + 0.9 * 0.2 / CORE_SHARE
    watch.period_ended(MOTION, 5.0)
    assert watch._pending is None
    now.s = 100.0 + 1.1 * 0.2 / CORE_SHARE
    watch.period_ended(MOTION, 5.0)
    assert watch._pending is not None


@pytest.mark.parametrize("worker", [None, SimpleNamespace(ask=lambda work: 1 / 0)])
def test_without_the_worker_process_there_are_no_results_and_the_log_states_it(worker):
    viewer = Viewer()
    watch, _, log = watch_of(False, worker, viewer)
    watch.period_ended(MOTION, 5.0)
    if worker is not None:
        assert watch._pending.ended.wait(30.0)
        watch.look()
    watch.period_ended(MOTION, 5.0)
    assert viewer.answers == []
    assert [kind for kind, _ in log.events] == ["host"]
    assert interim.NO_ANSWERS in log.events[0][1]


# -- the samples, piece by piece ------------------------------------------------------------------------------


def filled(count, seed=1):
    rng, builder = np.random.default_rng(seed), RecordingBuilder()
    for number in range(count):
        position = float(number) if number % 3 == 0 else None
        builder.add_values(0.01 * number, *rng.standard_normal(2), True, number % 5 == 0, position_rad=position)
    builder.excitation(MOTION)
    builder.learn(gear_ratio=2.0)
    return builder


def test_a_recording_in_parts_is_the_recording():
    builder, other, sent = RecordingBuilder(), RecordingBuilder(), None
    source = filled(100)
    values = source.recording()
    for number in range(100):
        position = None if np.isnan(values.position_rad[number]) else float(values.position_rad[number])
        builder.add_values(values.time_s[number], values.speed_rad_s[number], values.torque_nm[number], True,
                           bool(values.limited[number]), position_rad=position)
        if number in (9, 10, 57, 99):
            sent = builder.part(sent)
            other.join(sent)
    builder.excitation(MOTION)
    builder.learn(gear_ratio=2.0)
    other.join(builder.part(sent))
    found = other.recording()
    for name in ("time_s", "speed_rad_s", "torque_nm", "limited", "position_rad"):
        assert np.array_equal(getattr(found, name), getattr(values, name), equal_nan=True), name
    assert (found.gear_ratio, found.excitation) == (2.0, MOTION)
    with pytest.raises(ValueError, match="begins with sample"):
        other.join(replace(builder.part(), begin=7))


def test_the_worker_process_keeps_the_samples_and_a_first_part_restarts_them():
    asked, builder = Interim(MOTION, identify_plainly, 0.95, 0.95), filled(20)
    for _ in range(2):
        assert answer_with(builder.part(), asked).found.inertia_kg_m2 is None
        assert len(interim._kept[0]) == 20


# -- in stage 5 ----------------------------------------------------------------------------------------------


class Asked:
    """Watch that records its calls."""

    def __init__(self):
        self.motions, self.left_s, self.looks = [], [], 0

    def period_ended(self, motion, least_left_s):
        self.motions.append(motion)
        self.left_s.append(least_left_s)

    def look(self):
        self.looks += 1


def acquired(world, watch):
    here = world(FakeDrive())
    here.turn(PLAN.segments[0].reference.start_speed_rad_s, Mode.TORQUE)
    control = MeanSpeedControl(PLAN.guess, 100.0, ControlAssumptions())
    run_acquire(here.bench, here.limits, PLAN, control, lambda _: None, None, 0.0, watch)
    return here


def test_it_is_asked_after_whole_periods_and_the_setpoints_are_the_same(world):
    asked = Asked()
    seen, unseen = acquired(world, asked), acquired(world, None)
    assert seen.drive.commands == unseen.drive.commands
    whole = [[round((one.end_s - one.start_s) / one.period_s) for one in motion.segments] for motion in asked.motions]
    assert whole == [[2], [3], [4, 2], [4, 3]]
    assert asked.left_s == sorted(asked.left_s, reverse=True)
    assert asked.left_s[-1] == pytest.approx(PLAN.segments[-1].reference.period_s, abs=5.0)
    assert asked.looks > 1000


@pytest.mark.heavy
def test_the_live_answer_is_the_final_one_on_the_same_samples():
    """The samples are those of the log so far, and J is that of a replay of this part of the log."""
    log, viewer, lengths = BuilderLog(), Viewer(), []
    task = Task(LIMITS, ExcitationRequest(periods=5), {"torque_scale_rel_sd": 0.02})

    def counted(recording, confidence):
        lengths.append(len(recording.time_s))
        return identify_plainly(recording, confidence)

    Runner(LineDrive(Line(0.02), seed=5), lambda _: task, log, StopRequest(), viewer, lambda *_: None,
           identify=lambda: counted).run()
    whole, last = log.recording(complete=True), viewer.answers[-1]
    segments = [one for one in whole.excitation.segments if one.start_s < last.time_s]
    motion = replace(whole.excitation, segments=(*segments[:-1], replace(segments[-1], end_s=last.time_s)))
    signals = {name: getattr(whole, name)[:lengths[-1]]
               for name in ("time_s", "speed_rad_s", "torque_nm", "fresh", "limited")}
    final = identify(replace(whole, excitation=motion, commanded_torque_nm=None, **signals), Options())
    assert final.inertia is not None
    assert len(segments) == 2
    for name in ("low", "high", "low_total", "high_total"):
        assert getattr(last, f"{name}_kg_m2") == pytest.approx(getattr(final.inertia, name), rel=1e-9)
    assert last.inertia_kg_m2 == pytest.approx(final.inertia.value, rel=1e-9)
    assert last.p_value == pytest.approx(final.residual.p_value, rel=1e-6)
    assert log.inertias == viewer.answers
