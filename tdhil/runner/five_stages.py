"""Runs the five stages in order, and after every end the one stop sequence.

The first cause is kept. Errors during the stop are reported beside it, never instead of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial

from drivers import Command, Drive, DriveLimits, Mode, Outcome, Paced, Preflight, PreflightRefused, Sample, Timed
from profiles import MessageCode
from tdhil.config import told_before_echo
from tdhil.estimation import torque_answer
from tdhil.recording import Excitation, ImpedanceInput, LagPrior, Ramp, RunLog
from tdhil.runner import preconditions, stage_log
from tdhil.runner.background import WorkerProcess, begin
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import Guard
from tdhil.runner.planning import request_of
from tdhil.runner.preconditions import (
    choose_mode,
    choose_rate,
    keep_within,
    no_torque,
    quieten,
    refuse_slow_reference,
    refuse_with_string,
    with_known_lag,
    with_read_filters,
    with_timing,
)
from tdhil.runner.settings import StopRequest
from tdhil.runner.speed_check import SpeedWitness
from tdhil.runner.stage_log import StageBook
from tdhil.runner.stage_planner import StagePlanner
from tdhil.runner.stages import (
    NOT_YET,
    MeanSpeedControl,
    SpeedResult,
    TorqueResult,
    course_of,
    go_to,
    measure_offsets,
    probe_sign,
    refuse_other_rig,
    run_hold,
    run_offset,
    run_pilot,
    run_plan,
    run_speed,
    run_torque,
    run_virtual_string,
    slow_down,
)
from tdhil.runner.stop import StopReport, StopSequence
from tdhil.runner.task import Confirm, ConfirmSpeed, Display, MakeTask, RunOutcome, Say, Task, refuse_unconfirmed_speed
from tdhil.soft_torque import EvaluationCase, SpeedProgram


def _nothing(text: str) -> None:
    pass


class Runner:
    """One run of one drive. `run` never raises: errors are in the outcome."""

    def __init__(
        self,
        drive: Drive,
        make_task: MakeTask,
        log: RunLog,
        stop_request: StopRequest,
        display: Display,
        confirm: Confirm,
        *,
        reset_fault: bool = False,
        say: Say = _nothing,
        confirm_speed: ConfirmSpeed = refuse_unconfirmed_speed,
    ) -> None:
        self._drive = drive
        self._make_task = make_task
        self._reset_fault = reset_fault
        self._say = say
        self._log = log
        self._stop_request = stop_request
        self._display = display
        self._confirm = confirm
        self._confirm_speed = confirm_speed
        self._book = StageBook(drive, log, display, say)
        self._stop: StopSequence | None = None
        self._prior = LagPrior()
        self._before_echo = False
        self._worker_process: WorkerProcess | None = None

    def run(self) -> RunOutcome:
        """Connect, run five stages, stop, close."""
        cause: BaseException | None = None
        report: StopReport | None = None
        try:
            self._run_stages()
        except BaseException as error:
            cause = error
            self._log_failure(error)
        finally:
            if self._worker_process is not None:
                self._worker_process.end()
            if self._stop is not None:
                report = self._stop.run()
                with suppress(Exception):
                    self._log.configure(stop={"confirmed": report.confirmed, "at_rest_s": report.at_rest_s})
                with suppress(Exception):
                    for trouble in report.trouble:
                        self._log.event(self._drive.clock.now_s(), "stop", trouble)
                with suppress(Exception):
                    self._display.stopped(report.confirmed)
            with suppress(Exception):
                stage_log.tell(self._drive, self._log.configure, self._say)
            with suppress(Exception):
                self._log.configure(counters=asdict(self._drive.counters))
            try:
                left = self._drive.close()
            except Exception as error:
                cause = cause or error
            else:
                with suppress(Exception):
                    for line in left:
                        self._log.event(self._drive.clock.now_s(), "left", f"not restored: {line}")
            if self._worker_process is not None:
                self._worker_process.close()
            if cause is None:
                with suppress(Exception):
                    self._learn_torque_answer()
        return RunOutcome(tuple(self._book.stages), cause, report, self._book.preflight)

    # -- the stages ------------------------------------------------------------------------------------------

    def _run_stages(self) -> None:
        with self._book.stage("setup", 10.0):
            task, loop, preflight = self._prepare()
            limits, assumptions = task.limits, task.assumptions
            mode = choose_mode(task.request, limits, preflight)
            self._before_echo = told_before_echo(task.request.kind)
            _, torque_offset = measure_offsets(loop, limits)
            loop.guard.observer.torque_offset_nm = torque_offset
            program = None if task.evaluation is None else self._program(task, task.evaluation, loop, preflight)
            self._log.learn(torque_offset_nm=torque_offset)
            self._confirm(task, preflight, lambda: self._idle(loop))
            self._stop = StopSequence(
                loop,
                limits,
                preflight.speed_resolution_rad_s,
                preflight.quick_stop_in_torque_mode,
                assumptions,
                torque_resolution_nm=preflight.torque_resolution_nm,
                torque_offset_nm=torque_offset,
                watched=preflight.watched,
            )
            loop.guard.start_clock(loop.now_s)
            breakaway = probe_sign(loop, limits, mode, preflight.speed_resolution_rad_s)
            if breakaway is not None:
                self._log.event(loop.now_s, "probe", f"the shaft moved forward at {breakaway:.1f} N·m")
        with self._book.stage("speed", 50.0):
            witness = SpeedWitness(
                self._confirm_speed, preflight.identity.simulated, limits.accept_speed_unit, self._say
            )
            speed = run_speed(
                loop, limits, assumptions, preflight.speed_resolution_rad_s, torque_offset, witness
            )
            self._log.motion(None, speed.levels, (speed.ramp,))
            self._note_rough(loop, speed)
            self._note_timing(loop, speed)
            resolution = preflight.speed_resolution_rad_s
            slow: tuple[Sample, ...] = ()
            if mode is Mode.TORQUE:
                slow, speed = slow_down(loop, limits, speed, assumptions, resolution)
        ramps: tuple[Ramp, ...] = (speed.ramp,)
        drifted: TorqueResult | None = None
        if mode is Mode.TORQUE:
            with self._book.stage("torque", 15.0):
                drifted = run_torque(
                    loop, limits, assumptions, speed, slow, torque_offset, resolution, preflight.torque_setpoint
                )
                ramps = (speed.ramp, drifted.ramp)
                self._log.motion(None, speed.levels, ramps)
        else:
            why = no_torque(task.request.mode, preflight)
            self._book.skip("torque", f"{why}: no switch, and no second estimate of the inertia from a drift")
        model = self._model(loop, speed, drifted)
        if task.evaluation is not None and program is not None:
            self._run_virtual_string(task, task.evaluation, program, loop, speed, drifted, resolution)
            return
        if task.request.impedance == "offset":
            self._run_offset(task, loop, speed, ramps, resolution)
            return
        planner = StagePlanner(loop, self._log, self._display, self._say)
        planned = planner.plan(task, speed, mode, self._prior)
        plan = planned.plan
        control: MeanSpeedControl | None = None
        if drifted is not None:
            with self._book.stage("hold", 15.0):
                control = MeanSpeedControl(model, 0.25 * limits.torque_nm, assumptions)
                run_hold(
                    loop, limits, model, control, plan.start_rad_s, drifted.speed_rad_s,
                    preflight.speed_resolution_rad_s, speed.wander_rad_s,
                )
        else:
            self._book.skip("hold", f"{why}: the drive's own speed control holds the mean speed")
        with self._book.stage("acquire", planned.duration_s + 10.0):
            announced = self._announcer(speed, ramps)
            run_plan(
                loop, limits, plan, control, assumptions, announced, planner.enough(planned),
                preflight.speed_resolution_rad_s,
            )

    def _program(self, task: Task, case: EvaluationCase, loop: ControlLoop, preflight: Preflight) -> SpeedProgram:
        """Return the virtual string's speed program, before motion. Raises an error if it is refused."""
        if case.own_loop and preflight.torque_offset_resolution_nm <= 0.0:
            raise PreflightRefused(
                "the profile names no torque offset of the drive, which --own-loop needs to apply the string's torque",
                where="--own-loop", next_step="Remove --own-loop: the host's controller in torque mode needs none",
                entry=MessageCode.VIRTUAL_STRING_REFUSED,
            )
        course = partial(course_of, case, task.limits, loop.period_s, Guard.foresight_s(task.assumptions))
        program = loop.compute(course, Command(Mode.SPEED, 0.0, 0.0))
        self._log.configure(evaluation={"case": case.plain(), "program": asdict(program)})
        return program

    def _run_virtual_string(
        self, task: Task, case: EvaluationCase, program: SpeedProgram, loop: ControlLoop, speed: SpeedResult,
        drifted: TorqueResult | None, resolution_rad_s: float,
    ) -> None:
        """Run stages 4 and 5 with a virtual string."""
        limits, assumptions = task.limits, task.assumptions
        refuse_other_rig(case, speed.model)
        if drifted is not None and loop.guard.no_braking:
            raise PreflightRefused(
                f"a virtual string needs braking torque: {loop.guard.no_braking}", where="braking probe",
                next_step=loop.guard.to_brake,
                entry=MessageCode.BRAKING_UNCLEAR,
            )
        start = program.start_rad_s * case.rig.gear_ratio
        with self._book.stage("hold", 15.0):
            if drifted is None:
                go_to(loop, limits, speed.model, start, resolution_rad_s)
            else:
                control = MeanSpeedControl(speed.model, 0.25 * limits.torque_nm, assumptions)
                run_hold(loop, limits, speed.model, control, start, drifted.speed_rad_s, resolution_rad_s)
        with self._book.stage("acquire", program.longest_s):
            run_virtual_string(
                loop, limits, case, program, self._log.virtual, self._say, resolution_rad_s, speed.high.speed_sd_rad_s
            )

    def _run_offset(
        self, task: Task, loop: ControlLoop, speed: SpeedResult, ramps: tuple[Ramp, ...], resolution_rad_s: float
    ) -> None:
        """Run stages 4 and 5 of a measurement of the drive's own impedance with its torque offset."""
        limits, assumptions = task.limits, task.assumptions
        room = Guard.room(limits, assumptions)
        with self._book.stage("hold", 60.0):
            found = run_pilot(
                loop, limits, room, speed.model, assumptions, request_of(task.request, Mode.SPEED.value),
                string_at_motor(task), resolution_rad_s,
            )
            plan = found.plan
            self._display.planned(plan)
            text = (
                f"torque offset of up to {found.peak_nm:.0f} N·m, {plan.duration_s:.0f} s, speed"
                f" {plan.speed_min_rad_s:.2f} to {plan.speed_max_rad_s:.2f} rad/s"
            )
            self._log.event(loop.now_s, "plan", text)
            self._say(text)
            self._log.configure(plan=plan.plain() | {"torque_amplitudes_nm": list(found.torque_amplitudes_nm)})
        with self._book.stage("acquire", plan.duration_s + 10.0):
            run_offset(loop, found, self._announcer(speed, ramps), resolution_rad_s)

    def _prepare(self) -> tuple[Task, ControlLoop, Preflight]:
        identity = self._drive.connect()
        self._log.learn(simulated=identity.simulated)
        task = self._make_task(identity)
        limits = task.limits
        self._log.learn(**task.facts)
        if self._reset_fault:
            self._log.event(self._drive.clock.now_s(), "reset", "fault reset, requested by the operator")
            self._drive.reset_fault()
        no_worker_process = ""
        if not self._drive.clock.stepped:
            no_worker_process = self._make_ready()
        preflight = self._book.preflight = self._drive.preflight(
            DriveLimits(
                limits.speed_max_rad_s, limits.torque_nm, limits.quick_stop_rad_s2, limits.watchdog_s,
                limits.accept_no_watchdog, limits.accept_wider, limits.accept_shared_watchdog,
                limits.temperature_c,
                string=limits.winds_up,
                torque_offset=task.request.impedance == "offset"
                or (task.evaluation is not None and task.evaluation.own_loop),
            )
        )
        self._display.preflight(preflight)
        for check in preflight.checks:
            wanted = f"required {check.wanted}, " if check.wanted else ""
            text = f"{check.name}: {wanted}found {check.found} ({check.outcome.value}) {check.where}"
            self._log.event(self._drive.clock.now_s(), "preflight", text)
        if preflight.refused:
            raise _refusal(preflight)
        refuse_with_string(limits, task.request, preflight)
        limits = keep_within(limits, task.request, preflight)
        task = replace(task, limits=limits)
        if not preflight.watched:
            self._log.configure(**preconditions.configuration(preflight))
            self._log.event(self._drive.clock.now_s(), "watchdog", preconditions.SAID)
            self._say(preconditions.SAID)
        elif preflight.fed_by_any_client and not identity.simulated:
            self._log.configure(**preconditions.configuration(preflight))
            self._log.event(self._drive.clock.now_s(), "watchdog", preconditions.SAID_SHARED)
            self._say(preconditions.SAID_SHARED)
        self._choose_rate()
        # The rate of the line is known only now: the driver may have measured it in preflight.
        period_s = self._drive.period_s
        task = replace(task, assumptions=task.assumptions.at_period(period_s))
        self._log.configure(cycle={"period_s": period_s, "rate_hz": 1.0 / period_s})
        self._log.event(self._drive.clock.now_s(), "rate", f"{1.0 / period_s:.4g} cycles per second")
        refuse_slow_reference(task.request, period_s)
        if (by := task.request.impedance) is not None:
            count = preflight.torque_offset_resolution_nm if by == "offset" else preflight.speed_resolution_rad_s
            self._log.learn(
                impedance=ImpedanceInput(by, count, task.request.reference_filter_s, string_at_motor(task))
            )
        self._prior = with_read_filters(task.facts.get("lag_prior", LagPrior()), preflight.filters)
        task = replace(task, assumptions=with_known_lag(task.assumptions, self._prior))
        self._log.learn(
            speed_resolution_rad_s=preflight.speed_resolution_rad_s,
            torque_resolution_nm=preflight.torque_resolution_nm,
            torque_limit_nm=limits.torque_nm,
            lag_prior=self._prior,
            position_gap_s=preflight.position_gap_s if math.isfinite(preflight.position_gap_s) else None,
        )
        guard = Guard(
            limits,
            period_s,
            preflight.speed_resolution_rad_s,
            preflight.torque_resolution_nm,
            task.assumptions,
        )
        guard.observer.position(preflight.position_resolution_rad, preflight.position_gap_s)
        guard.no_braking = NOT_YET
        if isinstance(self._drive, Timed):
            guard.host_late = self._drive.host_late
        loop = ControlLoop(self._drive, guard, self._log, self._stop_request, self._display.cycle)
        loop.worker_process = self._worker_process
        if no_worker_process:
            loop.no_worker_process(no_worker_process)
        return task, loop, preflight

    def _make_ready(self) -> str:
        """Load and start what would delay the loop later. Return why there is no worker process; empty if there is
        one.
        """
        stop_request = self._stop_request
        self._worker_process, why = begin(quieten, lambda: stop_request.signum is not None)
        stop_request.check()
        return why

    def _choose_rate(self) -> None:
        """Choose the highest rate that this computer sustains, if no rate is requested and its clock sets the pace."""
        drive = self._drive
        if not (isinstance(drive, Paced) and drive.rates_hz):
            return

        def cycle() -> Sample:
            self._stop_request.check()
            return drive.exchange(Command(Mode.SPEED, 0.0, 0.0))

        choice = choose_rate(drive, drive.rates_hz, cycle)
        self._log.event(drive.clock.now_s(), "rate", choice.text)
        self._log.configure(rate_tried=choice.plain())
        self._say(choice.text)

    def _model(self, loop: ControlLoop, speed: SpeedResult, drifted: TorqueResult | None) -> RigGuess:
        """Return the rough model of stage 2, and log its ratio to the drift of stage 3."""
        model = speed.model
        if drifted is not None and drifted.rough is not None:
            ratio = drifted.rough.inertia_kg_m2 / model.inertia_kg_m2
            text = f"rough inertia {model.inertia_kg_m2:.4g} kg·m² from the ramp, {ratio:.2f} times that from the drift"
            self._log.event(loop.now_s, "plan", text)
        return model

    def _announcer(self, speed: SpeedResult, ramps: tuple[Ramp, ...]) -> Callable[[Excitation], None]:
        return lambda motion: self._log.motion(motion, speed.levels, ramps)

    def _note_timing(self, loop: ControlLoop, speed: SpeedResult) -> None:
        """Note the uncertainty of the sample times. Torque and speed may be offset in time by as much."""
        half_s = sum(sample.half_width_s for sample in speed.last) / max(1, len(speed.last))
        if half_s > 0.0:
            self._prior = with_timing(self._prior, half_s)
            self._log.learn(timing_half_width_s=half_s, lag_prior=self._prior)
            text = f"sample times are known to ±{1e3 * half_s:.3g} ms, half the duration of a transaction"
            self._log.event(loop.now_s, "rate", text)

    def _learn_torque_answer(self) -> None:
        """Record how the reported torque follows the commanded one: the estimate before the echo needs it."""
        if self._before_echo:
            answer = torque_answer(self._log.recording(complete=True), self._log.commanded_nm)
            if answer is not None:
                self._log.learn(torque_answer=answer)

    def _note_rough(self, loop: ControlLoop, speed: SpeedResult) -> None:
        model = speed.model
        self._log.event(
            loop.now_s,
            "plan",
            f"rough model: J {model.inertia_kg_m2:.4g} kg·m² ± {100 * speed.rough.rel_error:.0f} %, "
            f"B {model.viscous_nm_s_rad:.3g} N·m·s/rad, T_c {model.coulomb_nm:.3g} N·m",
        )

    def _idle(self, loop: ControlLoop) -> None:
        loop.cycle(Command(Mode.SPEED, 0.0, 0.0))

    def _log_failure(self, error: BaseException) -> None:
        try:
            self._log.failure(self._drive.clock.now_s(), error)
        except Exception as also:
            error.add_note(f"and this error could not be logged: {also}")


def string_at_motor(task: Task) -> float:
    """Return the impedance ζ for the reported |r|, at the motor: requested, or of rig.yaml's pipe; 0: unknown."""
    asked, pipe = task.request.string_nm_s_rad, task.facts.get("pipe")
    if asked is not None:
        return asked / float(task.facts.get("gear_ratio", 1.0)) ** 2
    return 0.0 if pipe is None else float(pipe.impedance_nm_s_rad)


def _refusal(preflight: Preflight) -> PreflightRefused:
    refused = [check for check in preflight.checks if check.outcome is Outcome.REFUSED]
    first = refused[0]
    more = f" (and {len(refused) - 1} more, see the table)" if len(refused) > 1 else ""
    return PreflightRefused(
        f"{first.name}: required {first.wanted}, found {first.found}{more}",
        where=first.where, next_step=first.next_step,
        entry=MessageCode.PREFLIGHT_TABLE,
    )
