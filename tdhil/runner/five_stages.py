"""Runs one program of stages (`programs`) on one drive, and then the stop sequence, however the program ends.

The first cause is kept. Errors during the stop are reported beside it, never instead of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial

from drivers import Command, Drive, DriveLimits, Mode, Outcome, Paced, Preflight, PreflightRefused, Sample, Timed
from tdhil.config import OPTION, identified_before_echo
from tdhil.errors import MessageCode, TdhilError
from tdhil.estimation import torque_answer
from tdhil.recording import ImpedanceInput, LagPrior, RunLog
from tdhil.runner import preconditions, stage_log
from tdhil.runner.background import BackgroundProcess, begin
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.excitation import PlanRefused
from tdhil.runner.guard import Guard
from tdhil.runner.interim import Identify, identify_plainly
from tdhil.runner.planning import refuse_undersampled
from tdhil.runner.preconditions import (
    choose_mode,
    choose_rate,
    keep_within,
    load_before_motion,
    refuse_slow_reference,
    refuse_with_string,
    with_known_lag,
    with_read_filters,
)
from tdhil.runner.programs import Run, identify, offset_impedance
from tdhil.runner.settings import ExcitationRequest, StopRequest
from tdhil.runner.stage_log import StageBook
from tdhil.runner.stages import NOT_YET, measure_torque_offset
from tdhil.runner.standstill import standstill_speed
from tdhil.runner.stop import StopReport, StopSequence, mode_not_left
from tdhil.runner.task import Confirm, ConfirmSpeed, Display, MakeTask, RunOutcome, Say, Task, refuse_unconfirmed_speed

Program = Callable[[Run], None]


def program_of(task: Task) -> Program:
    """Return the program for a task. The packages of a case load only if the task has one."""
    if task.case is None:
        return offset_impedance if task.request.impedance == "offset" else identify
    from tdhil.speed_loop import StepCase

    if isinstance(task.case, StepCase):
        from tdhil.runner.speed_steps_program import speed_steps

        return partial(speed_steps, case=task.case)
    from tdhil.runner.virtual_string_program import virtual_string

    return partial(virtual_string, case=task.case)


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
        identify: Callable[[], Identify] = lambda: identify_plainly,
    ) -> None:
        """``identify`` is called before stage 5, when the log has the identity of the drive."""
        self._drive = drive
        self._make_task = make_task
        self._reset_fault = reset_fault
        self._say = say
        self._log = log
        self._stop_request = stop_request
        self._display = display
        self._confirm = confirm
        self._confirm_speed = confirm_speed
        self._identify = identify
        self._book = StageBook(drive, log, display, say)
        self._stop: StopSequence | None = None
        self._before_echo = False
        self._worker_process: BackgroundProcess | None = None

    def run(self) -> RunOutcome:
        """Connect, run five stages, stop, close."""
        cause: BaseException | None = None
        report: StopReport | None = None
        try:
            with ExitStack() as setup:
                setup.enter_context(self._book.stage("setup", 10.0))
                run, program = self._prepare(setup.close)
                program(run)           # ends stage 1, and runs the others
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
                beside = [f"error beside the stop, which went on: {one}" for one in report.beside]
                with suppress(Exception):
                    for trouble in (*report.trouble, *beside):
                        self._log.event(self._drive.clock.now_s(), "stop", trouble)
                for error_text in beside:
                    with suppress(Exception):
                        self._say(error_text)
                with suppress(Exception):
                    self._display.stopped(report.confirmed)
                if isinstance(cause, TdhilError) and cause.stops:
                    cause.stopped = report.confirmed
                    with suppress(Exception):
                        self._log.stopped(cause)
                if cause is None and report.stayed_in_torque_mode:
                    cause = mode_not_left()
                    self._log_failure(cause)
            with suppress(Exception):
                stage_log.report_others(self._drive, self._log.configure, self._say)
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
                if left:
                    with suppress(Exception):
                        self._say(_left_in_drive(left))
            if self._worker_process is not None:
                self._worker_process.close()
            if cause is None and self._before_echo:
                # how the reported torque follows the commanded one: the estimate from before the echo needs it
                with suppress(Exception):
                    answer = torque_answer(self._log.recording(complete=True), self._log.commanded_nm)
                    if answer is not None:
                        self._log.learn(torque_answer=answer)
        return RunOutcome(tuple(self._book.stages), cause, report, self._book.preflight)

    # -- the stages ------------------------------------------------------------------------------------------

    def _armed(self, stop: StopSequence) -> None:
        self._stop = stop

    def _prepare(self, end_setup: Callable[[], None]) -> tuple[Run, Program]:
        """Connect, check and set the drive, and measure its offsets at standstill. The shaft does not move.

        Return what the stages need, and the program that follows.
        """
        identity = self._drive.connect()
        self._log.learn(simulated=identity.simulated)
        task = self._make_task(identity)
        self._log.learn(**task.facts)
        program = program_of(task)       # before anything is armed: it may load modules
        if self._reset_fault:
            self._log.event(self._drive.clock.now_s(), "reset", "fault reset, requested by the operator")
            self._drive.reset_fault()
        no_worker_process = ""
        if not self._drive.clock.stepped:
            stop_request = self._stop_request
            self._worker_process, no_worker_process = begin(load_before_motion, lambda: stop_request.signum is not None)
            stop_request.check()
        preflight = self._check_drive(task)
        refuse_with_string(task.limits, task.request, preflight)
        task = replace(task, limits=keep_within(task.limits, task.request, preflight))
        self._tell_watchdog(preflight)
        task = self._set_rate(task)
        prior = with_read_filters(task.facts.get("lag_prior", LagPrior()), preflight.filters)
        task = replace(task, assumptions=with_known_lag(task.assumptions, prior))
        self._learn_inputs(task, preflight, prior)
        loop = self._make_loop(task, preflight, no_worker_process)
        mode = choose_mode(task.request, task.limits, preflight)
        self._before_echo = identified_before_echo(task.request.kind)
        at_rest_rad_s = standstill_speed(task.limits, preflight.speed_resolution_rad_s)
        torque_offset_nm = measure_torque_offset(loop, at_rest_rad_s)
        loop.guard.observer.torque_offset_nm = torque_offset_nm
        run = Run(
            task, mode, loop, preflight, torque_offset_nm, prior, self._book, self._log, self._display, self._say,
            self._confirm, self._confirm_speed, self._armed, end_setup, self._identify,
        )
        return run, program

    def _check_drive(self, task: Task) -> Preflight:
        """Run the drive's preflight with the limits of the task. Raises PreflightRefused with its first refusal."""
        limits = task.limits
        found = self._drive.preflight(
            DriveLimits(
                limits.speed_max_rad_s, limits.torque_nm, limits.quick_stop_rad_s2, limits.watchdog_s,
                limits.accept_no_watchdog, limits.accept_wider, limits.accept_shared_watchdog,
                limits.temperature_c,
                string=limits.has_drill_string,
                torque_offset=task.request.impedance == "offset"
                or (task.case is not None and task.case.torque_offset),
                noise_scale_rad_s=limits.noise_scale_rad_s,
            )
        )
        taken = preconditions.scales_taken_as_true(found, calibrated=task.calibrated)
        preflight = self._book.preflight = replace(found, checks=(*found.checks, *taken))
        self._display.preflight(preflight)
        for check in preflight.checks:
            wanted = f"required {check.wanted}, " if check.wanted else ""
            text = f"{check.name}: {wanted}found {check.found} ({check.outcome.value}) {check.where}"
            self._log.event(self._drive.clock.now_s(), "preflight", text)
        if preflight.refused:
            raise _refusal(preflight)
        return preflight

    def _tell_watchdog(self, preflight: Preflight) -> None:
        """Tell the operator of a drive that has no watchdog, or a real one whose watchdog any client feeds."""
        if not preflight.watched:
            said = preconditions.SAID
        elif preflight.fed_by_any_client and not preflight.identity.simulated:
            said = preconditions.SAID_SHARED
        else:
            return
        self._log.configure(**preconditions.configuration(preflight))
        self._log.event(self._drive.clock.now_s(), "watchdog", said)
        self._say(said)

    def _set_rate(self, task: Task) -> Task:
        """Choose the highest cycle rate that this computer sustains, if no rate is requested and its clock sets the
        pace. Return the task with what the host assumes at the rate.
        """
        drive = self._drive
        if isinstance(drive, Paced) and drive.rates_hz:

            def cycle() -> Sample:
                self._stop_request.check()
                return drive.exchange(Command(Mode.SPEED, 0.0, 0.0))

            choice = choose_rate(drive, drive.rates_hz, cycle)
            self._log.event(drive.clock.now_s(), "rate", choice.text)
            self._log.configure(rate_tried=choice.plain())
            self._say(choice.text)
        # The rate of the line is known only now: the driver may have measured it in preflight.
        period_s = drive.period_s
        self._log.configure(cycle={"period_s": period_s, "rate_hz": 1.0 / period_s})
        self._log.event(drive.clock.now_s(), "rate", f"{1.0 / period_s:.4g} cycles per second")
        refuse_slow_reference(task.request, period_s)
        if task.case is None:
            _refuse_undersampled(task.request, period_s)
        return replace(task, assumptions=task.assumptions.at_period(period_s))

    def _learn_inputs(self, task: Task, preflight: Preflight, prior: LagPrior) -> None:
        """Write the data of the drive and of the request that identification needs to the log."""
        if (by := task.request.impedance) is not None:
            count = preflight.torque_offset_resolution_nm if by == "offset" else preflight.speed_resolution_rad_s
            self._log.learn(
                impedance=ImpedanceInput(by, count, task.request.reference_filter_s, task.string_at_motor_nm_s_rad)
            )
        if preflight.speed_loop is not None:
            self._log.configure(speed_loop_present=asdict(preflight.speed_loop))
        self._log.learn(
            speed_resolution_rad_s=preflight.speed_resolution_rad_s,
            torque_resolution_nm=preflight.torque_resolution_nm,
            torque_limit_nm=task.limits.torque_nm,
            lag_prior=prior,
            position_gap_s=preflight.position_gap_s if math.isfinite(preflight.position_gap_s) else None,
        )

    def _make_loop(self, task: Task, preflight: Preflight, no_worker_process: str) -> ControlLoop:
        guard = Guard(
            task.limits,
            self._drive.period_s,
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
        return loop

    def _log_failure(self, error: BaseException) -> None:
        try:
            self._log.failure(self._drive.clock.now_s(), error)
        except Exception as also:
            error.add_note(f"and this error could not be logged: {also}")


def _left_in_drive(left: Iterable[str]) -> str:
    """Return the message to the operator: the settings that were not restored, those with one reason together."""
    names: dict[str, list[str]] = {}
    for line in left:
        name, _, reason = line.partition(": ")
        names.setdefault(reason, []).append(name)
    said = "; ".join(f"{', '.join(found)}: {reason}" for reason, found in names.items())
    return f"not restored in the drive: {said}. Check these settings at the drive before the next run"


def _refuse_undersampled(request: ExcitationRequest, period_s: float) -> None:
    """Refuse, before motion, spectral lines that the rate of this run can't show."""
    try:
        refuse_undersampled(request, 1.0 / period_s)
    except PlanRefused as error:
        raise PreflightRefused(
            str(error), where=OPTION["frequency_hz"].flag, next_step=f"{error.next_step}; or raise --rate",
            entry=MessageCode.PLAN_HOPELESS,
        ) from error


def _refusal(preflight: Preflight) -> PreflightRefused:
    refused = [check for check in preflight.checks if check.outcome is Outcome.REFUSED]
    first = refused[0]
    more = f" (and {len(refused) - 1} more, see the table)" if len(refused) > 1 else ""
    return PreflightRefused(
        f"{first.name}: required {first.wanted}, found {first.found}{more}",
        where=first.where, next_step=first.next_step,
        entry=MessageCode.PREFLIGHT_TABLE,
    )
