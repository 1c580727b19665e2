"""Runs the five stages in order, and whatever happens in them, the one stop sequence.

The first cause is kept: what goes wrong while stopping is reported beside it, never instead of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

from drivers.drive import Command, Drive, Identity, Limits, Mode, Outcome, Preflight, ReportingFilters, Sample
from drivers.errors import PreflightRefused
from tdhil.errors import Interrupted
from tdhil.protocol import excitation, no_watchdog
from tdhil.protocol.bench import Bench
from tdhil.protocol.braking_probe import NOT_YET, slow_down, torque_setpoint
from tdhil.protocol.control import MeanSpeedControl
from tdhil.protocol.design import Knowledge, assumed_noise, measured_noise
from tdhil.protocol.enough import Decision, Enough
from tdhil.protocol.excitation import Plan, PlanRefused, RigGuess, SwingPlan
from tdhil.protocol.guard import Guard
from tdhil.protocol.planning import Planned, as_followed, plan_acquisition
from tdhil.protocol.settings import ControlAssumptions, ExcitationRequest, MachineLimits, StopRequest
from tdhil.protocol.stage_acquire import run_acquire
from tdhil.protocol.stage_hold import run_hold
from tdhil.protocol.stage_quality import stage_quality
from tdhil.protocol.stage_setup import measure_offsets, probe_sign
from tdhil.protocol.stage_speed import SpeedResult, run_speed
from tdhil.protocol.stage_swing import run_swings
from tdhil.protocol.stage_torque import TorqueResult, run_torque
from tdhil.protocol.stop import StopReport, StopSequence
from tdhil.protocol.string_rules import refuse_with_string
from tdhil.record.recording import Excitation, LagPrior, Ramp, Stage, SteppedSetpoint
from tdhil.record.run_log import RunLog

STAGES = ("setup", "speed", "torque", "hold", "acquire")

RESERVE_S = 30.0
"""Of the run's time limit, kept for stage 4 and the transitions when stage 5 is planned."""

Idle = Callable[[], None]
"""One cycle of nothing, which keeps the drive's watchdog fed while somebody makes up his mind."""


class Display(Protocol):
    """Whoever shows a run as it goes."""

    def preflight(self, preflight: Preflight) -> None: ...

    def stage_started(self, name: str, expected_s: float) -> None: ...

    def cycle(self, command: Command, sample: Sample) -> None: ...

    def planned(self, plan: Plan | SwingPlan) -> None: ...

    def stage_ended(self, stage: Stage) -> None: ...

    def stopped(self, confirmed: bool) -> None: ...


Say = Callable[[str], None]
"""Tells whoever watches one line."""


def _nothing(text: str) -> None:
    pass


Confirm = Callable[["Task", Preflight, Idle], None]
"""Asks whether the shaft may be moved; raises PreflightRefused if not."""


@dataclass(frozen=True)
class RunOutcome:
    """How a run went: its stages, what ended it (None = it went to its end), and how the stop went."""

    stages: tuple[Stage, ...]
    cause: BaseException | None
    stop: StopReport | None            # None: the drive was never enabled
    preflight: Preflight | None


@dataclass(frozen=True)
class Task:
    """What to do with a drive. ``facts`` are those of the bench, by their names in Recording."""

    limits: MachineLimits
    request: ExcitationRequest
    facts: Mapping[str, Any] = field(default_factory=dict)
    assumptions: ControlAssumptions = field(default_factory=ControlAssumptions)


MakeTask = Callable[[Identity], Task]
"""The task for whoever turned out to be at the other end; raises PreflightRefused if he can't have one."""


class Runner:
    """One run of one drive. `run` never raises: everything is in the outcome."""

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
    ) -> None:
        self._drive = drive
        self._make_task = make_task
        self._reset_fault = reset_fault
        self._say = say
        self._log = log
        self._stop_request = stop_request
        self._display = display
        self._confirm = confirm
        self._stages: list[Stage] = []
        self._preflight: Preflight | None = None
        self._stop: StopSequence | None = None
        self._prior = LagPrior()

    def run(self) -> RunOutcome:
        """Connect, five stages, stop, close."""
        cause: BaseException | None = None
        report: StopReport | None = None
        try:
            self._run_stages()
        except BaseException as error:
            cause = error
            self._log_failure(error)
        finally:
            if self._stop is not None:
                report = self._stop.run()
                with suppress(Exception):
                    for trouble in report.trouble:
                        self._log.event(self._drive.clock.now_s(), "stop", trouble)
                with suppress(Exception):
                    self._display.stopped(report.confirmed)
            with suppress(Exception):
                self._log.configure(counters=asdict(self._drive.counters))
            try:
                left = self._drive.close()
            except Exception as error:
                cause = cause or error
            else:
                with suppress(Exception):
                    for line in left:
                        self._log.event(self._drive.clock.now_s(), "left", f"not given back: {line}")
        return RunOutcome(tuple(self._stages), cause, report, self._preflight)

    # -- the stages ------------------------------------------------------------------------------------------

    def _run_stages(self) -> None:
        with self._stage("setup", 10.0):
            task, bench, preflight = self._prepare()
            limits, assumptions = task.limits, task.assumptions
            mode = _choose_mode(task.request, limits, preflight)
            _, torque_offset = measure_offsets(bench, limits)
            self._log.learn(torque_offset_nm=torque_offset)
            self._confirm(task, preflight, lambda: self._idle(bench))
            self._stop = StopSequence(
                bench,
                limits,
                preflight.speed_resolution_rad_s,
                preflight.quick_stop_in_torque_mode,
                assumptions,
                torque_resolution_nm=preflight.torque_resolution_nm,
                torque_offset_nm=torque_offset,
                watched=preflight.watched,
            )
            bench.guard.start_clock(bench.now_s)
            breakaway = probe_sign(bench, limits, mode, preflight.speed_resolution_rad_s)
            if breakaway is not None:
                self._log.event(bench.now_s, "probe", f"the shaft moved forward at {breakaway:.1f} N·m")
        with self._stage("speed", 50.0):
            speed = run_speed(bench, limits, assumptions, preflight.speed_resolution_rad_s, torque_offset)
            self._log.motion(None, speed.levels, (speed.ramp,))
            self._note_rough(bench, speed)
            self._note_timing(bench, speed)
            resolution = preflight.speed_resolution_rad_s
            slow: tuple[Sample, ...] = ()
            if mode is Mode.TORQUE:
                slow = slow_down(bench, limits, speed.model, assumptions, speed.high.speed_rad_s, resolution)
        ramps: tuple[Ramp, ...] = (speed.ramp,)
        drifted: TorqueResult | None = None
        if mode is Mode.TORQUE:
            with self._stage("torque", 15.0):
                drifted = run_torque(
                    bench, limits, assumptions, speed, slow, torque_offset, resolution, torque_setpoint(preflight)
                )
                ramps = (speed.ramp, drifted.ramp)
                self._log.motion(None, speed.levels, ramps)
        else:
            why = _no_torque(task.request.mode, preflight)
            self._skip("torque", bench, f"{why}: no switch, and no second look at the inertia by a drift")
        model = self._model(bench, speed, drifted)
        planned = self._plan(task, bench, speed, mode)
        plan = planned.plan
        control: MeanSpeedControl | None = None
        if drifted is not None:
            with self._stage("hold", 15.0):
                control = MeanSpeedControl(model, 0.25 * limits.torque_nm, assumptions)
                target = plan.start_rad_s if isinstance(plan, SwingPlan) else plan.segments[0].reference.offset_rad_s
                run_hold(bench, limits, model, control, target, drifted.speed_rad_s, preflight.speed_resolution_rad_s)
        else:
            self._skip("hold", bench, f"{why}: the drive's own speed control holds the mean speed")
        with self._stage("acquire", planned.duration_s + 10.0):
            announced = self._announcer(speed, ramps)
            if isinstance(plan, SwingPlan):
                run_swings(bench, limits, plan, control, assumptions, announced)
            else:
                run_acquire(
                    bench, limits, plan, control, announced, self._enough(planned, bench),
                    preflight.speed_resolution_rad_s,
                )

    def _prepare(self) -> tuple[Task, Bench, Preflight]:
        identity = self._drive.connect()
        self._log.learn(simulated=identity.simulated)
        task = self._make_task(identity)
        limits = task.limits
        self._log.learn(**task.facts)
        if self._reset_fault:
            self._log.event(self._drive.clock.now_s(), "reset", "fault reset, as asked for by the operator")
            self._drive.reset_fault()
        preflight = self._preflight = self._drive.preflight(
            Limits(
                limits.speed_max_rad_s, limits.torque_nm, limits.quick_stop_rad_s2, limits.watchdog_s,
                limits.accept_no_watchdog,
            )
        )
        self._display.preflight(preflight)
        for check in preflight.checks:
            wanted = f"wanted {check.wanted}, " if check.wanted else ""
            text = f"{check.name}: {wanted}found {check.found} ({check.outcome.value}) {check.where}"
            self._log.event(self._drive.clock.now_s(), "preflight", text)
        if preflight.refused:
            raise _refusal(preflight)
        refuse_with_string(limits, task.request, preflight)
        if not preflight.watched:
            self._log.configure(**no_watchdog.configuration(preflight))
            self._log.event(self._drive.clock.now_s(), "watchdog", no_watchdog.SAID)
            self._say(no_watchdog.SAID)
        # What the line carries is known only now: the driver may have measured it in preflight.
        period_s = self._drive.period_s
        task = replace(task, assumptions=task.assumptions.at_period(period_s))
        self._log.configure(cycle={"period_s": period_s, "rate_hz": 1.0 / period_s})
        self._log.event(self._drive.clock.now_s(), "rate", f"{1.0 / period_s:.4g} cycles a second")
        self._prior = _with_read_filters(task.facts.get("lag_prior", LagPrior()), preflight.filters)
        task = replace(task, assumptions=_with_known_lag(task.assumptions, self._prior))
        self._log.learn(
            speed_resolution_rad_s=preflight.speed_resolution_rad_s,
            torque_resolution_nm=preflight.torque_resolution_nm,
            torque_limit_nm=limits.torque_nm,
            lag_prior=self._prior,
        )
        guard = Guard(
            limits,
            period_s,
            preflight.speed_resolution_rad_s,
            preflight.torque_resolution_nm,
            task.assumptions,
        )
        guard.no_braking = NOT_YET
        return task, Bench(self._drive, guard, self._log, self._stop_request, self._display.cycle), preflight

    def _model(self, bench: Bench, speed: SpeedResult, drifted: TorqueResult | None) -> RigGuess:
        """The rough rig: stage 2's, with the drift of stage 3 as a witness."""
        model = speed.model
        if drifted is not None and drifted.rough is not None:
            ratio = drifted.rough.inertia_kg_m2 / model.inertia_kg_m2
            text = f"rough inertia {model.inertia_kg_m2:.4g} kg·m² from the ramp, {ratio:.2f} of it from the drift"
            self._log.event(bench.now_s, "plan", text)
        return model

    def _plan(self, task: Task, bench: Bench, speed: SpeedResult, mode: Mode) -> Planned:
        request, limits, model = task.request, task.limits, speed.model
        room = excitation.MachineLimits(
            limits.speed_min_rad_s, limits.speed_max_rad_s, limits.torque_nm, Guard.foresight_s(task.assumptions)
        )
        course = speed.course if mode is Mode.SPEED else None
        last = bench.last
        speed_now = max(0.0, last.speed_rad_s) if last else 0.0
        keep = Command(mode, speed_now, model.steady_torque_nm(speed_now))
        left_s = bench.guard.left_s(bench.now_s) - RESERVE_S
        assumed = assumed_noise(limits.torque_nm, limits.speed_max_rad_s)
        theta = Knowledge(assumed, self._prior).theta(model)

        def work() -> Planned:
            known = Knowledge(measured_noise(speed.steady, theta, assumed), self._prior)
            if course is None:
                return plan_acquisition(request, mode.value, room, model, known, left_s)
            seen, within = as_followed(model, room, course, known.speed_lag_s)
            return plan_acquisition(request, mode.value, within, seen, known, left_s)

        try:
            planned = bench.compute(work, keep)
        except PlanRefused as error:
            raise PreflightRefused(
                str(error), where="plan of stage 5", next_step="Change --amplitude, --offset, --frequency or the limits"
            ) from error
        plan = planned.plan
        if mode is Mode.TORQUE and plan.torque_min_nm < 0.0 and bench.guard.no_braking:
            raise PreflightRefused(
                f"the plan needs braking torque, down to {plan.torque_min_nm:.0f} N·m: {bench.guard.no_braking}",
                where="plan of stage 5",
                next_step=bench.guard.to_brake,
            )
        if course is not None:
            self._note_following(bench, plan)
        self._display.planned(plan)
        self._log.event(
            bench.now_s,
            "plan",
            f"{plan.kind} in {plan.mode} mode, {plan.duration_s:.0f} s, speed {plan.speed_min_rad_s:.2f} to "
            f"{plan.speed_max_rad_s:.2f} rad/s, torque {plan.torque_min_nm:.0f} to {plan.torque_max_nm:.0f} N·m",
        )
        self._tell(bench, planned.said())
        self._log.configure(plan=planned.plain())
        if planned.stopping is not None:
            self._log.configure(stopping=planned.stopping.plain() | {"decisions": []})
        return planned

    def _note_following(self, bench: Bench, plan: Plan | SwingPlan) -> None:
        """What slow sampling of a stepped setpoint may do to J is identification's to say; it needs these."""
        following, ramp = plan.guess.following, plan.limits.acceleration_rad_s2
        if math.isfinite(ramp):
            text = f"the drive's own speed ramp holds the shaft to {ramp:.3g} rad/s²; stage 5 stays below it"
            self._tell(bench, text)
        if following is None:
            self._tell(bench, "how the drive follows its setpoint was not clear; stage 5 takes it to follow at once")
            return
        self._log.learn(
            stepped_setpoint=SteppedSetpoint(
                bench.period_s, following.zero_s, following.first_s, following.second_s2
            )
        )

    def _tell(self, bench: Bench, text: str) -> None:
        self._log.event(bench.now_s, "plan", text)
        self._say(text)

    def _enough(self, planned: Planned, bench: Bench) -> Enough | None:
        """Asks the scatter, where a tolerance was given; every decision is in the log before it is carried out."""
        rule = planned.stopping
        if rule is None:
            return None
        told: list[dict[str, Any]] = []

        def note(decision: Decision) -> None:
            told.append(decision.plain())
            self._log.configure(stopping=rule.plain() | {"decisions": list(told)})
            self._tell(bench, decision.why)

        assert isinstance(planned.plan, Plan)
        return Enough(rule, planned.plan, lambda: self._log.recording(complete=True), note)

    def _announcer(self, speed: SpeedResult, ramps: tuple[Ramp, ...]) -> Callable[[Excitation], None]:
        return lambda motion: self._log.motion(motion, speed.levels, ramps)

    def _note_timing(self, bench: Bench, speed: SpeedResult) -> None:
        """How far a sample's time may be off; torque and speed may be apart by as much."""
        half_s = sum(sample.half_width_s for sample in speed.last) / max(1, len(speed.last))
        if half_s > 0.0:
            self._prior = replace(self._prior, skew_sd_s=math.hypot(self._prior.skew_sd_s, half_s))
            self._log.learn(timing_half_width_s=half_s, lag_prior=self._prior)
            text = f"a sample's time is known to ±{1e3 * half_s:.3g} ms, the half of a transaction"
            self._log.event(bench.now_s, "rate", text)

    def _note_rough(self, bench: Bench, speed: SpeedResult) -> None:
        model = speed.model
        self._log.event(
            bench.now_s,
            "plan",
            f"rough model: J {model.inertia_kg_m2:.4g} kg·m² ± {100 * speed.rough.rel_error:.0f} %, "
            f"B {model.viscous_nm_s_rad:.3g} N·m·s/rad, T_c {model.coulomb_nm:.3g} N·m",
        )

    # -- around the stages -----------------------------------------------------------------------------------

    @contextmanager
    def _stage(self, name: str, expected_s: float) -> Iterator[None]:
        start_s = self._drive.clock.now_s()
        before = self._drive.counters
        try:
            self._display.stage_started(name, expected_s)
            self._announce(name)
            yield
        except BaseException as error:
            no_watchdog.correct(error, self._preflight)
            try:
                self._end_stage(Stage(name, start_s, self._drive.clock.now_s(), "aborted", _short(error)))
            except Exception as also:  # the first cause stays the cause
                error.add_note(f"and the end of the stage was not taken: {also}")
            raise
        after = self._drive.counters
        if after.wall_jumps > before.wall_jumps:
            self._log.event(self._drive.clock.now_s(), "clock",
                            "the wall clock jumped: stamps on the bus moved, the times in this log did not")
        if after.passive > before.passive:
            self._tell_bus("the adapter is error-passive: check bit rate, termination and cable")
        outcome, detail = stage_quality(before, after)
        self._end_stage(Stage(name, start_s, self._drive.clock.now_s(), outcome, detail))

    def _tell_bus(self, text: str) -> None:
        self._log.event(self._drive.clock.now_s(), "bus", text)
        self._say(text)

    def _announce(self, name: str) -> None:
        """A drive may pass it on to a simulated peer, whose scripted faults wait for it."""
        announce = getattr(self._drive, "announce", None)
        if announce is not None:
            announce(name)

    def _skip(self, name: str, bench: Bench, why: str) -> None:
        self._display.stage_started(name, 0.0)
        self._end_stage(Stage(name, bench.now_s, bench.now_s, "skipped", why))

    def _end_stage(self, stage: Stage) -> None:
        self._stages.append(stage)
        self._stages[-1] = stage = self._log.stage(stage)
        self._display.stage_ended(stage)

    def _idle(self, bench: Bench) -> None:
        bench.cycle(Command(Mode.SPEED, 0.0, 0.0))

    def _log_failure(self, error: BaseException) -> None:
        try:
            if isinstance(error, Interrupted):
                self._log.event(self._drive.clock.now_s(), "interrupted", str(error))
            else:
                self._log.failure(self._drive.clock.now_s(), error)
        except Exception as also:
            error.add_note(f"and the log did not take it: {also}")


def _refusal(preflight: Preflight) -> PreflightRefused:
    refused = [check for check in preflight.checks if check.outcome is Outcome.REFUSED]
    first = refused[0]
    more = f" (and {len(refused) - 1} more, see the table)" if len(refused) > 1 else ""
    return PreflightRefused(
        f"{first.name}: wanted {first.wanted}, found {first.found}{more}", where=first.where, next_step=first.next_step
    )


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[:300]


def _choose_mode(request: ExcitationRequest, limits: MachineLimits, preflight: Preflight) -> Mode:
    """Torque mode where the drive has it and can enter it while it turns, unless speed mode was asked for."""
    wanted, can_torque = request.mode, Mode.TORQUE in preflight.modes and preflight.switch_while_enabled
    if wanted == Mode.TORQUE.value and not can_torque:
        raise PreflightRefused(
            "torque mode was asked for, but this drive has none that can be entered while it turns",
            where="6502h and profile",
            next_step="Use --mode speed",
        )
    mode = Mode.SPEED if wanted == Mode.SPEED.value or not can_torque else Mode.TORQUE
    if request.kind == "coast-down" and limits.load != "none":
        raise PreflightRefused(
            f"coast-down was asked for, but a {limits.load} hangs on the shaft and would drive it back",
            where="--excitation and load in rig.yaml",
            next_step="Use --excitation multisine",
        )
    if request.kind == "coast-down" and mode is Mode.SPEED:
        raise PreflightRefused(
            f"coast-down was asked for, but {_no_torque(wanted, preflight)}: a shaft under speed control never coasts",
            where="--excitation",
            next_step="Use --excitation pulses or multisine",
        )
    return mode


def _no_torque(wanted: str | None, preflight: Preflight) -> str:
    """Why the run is not in torque mode."""
    if Mode.TORQUE not in preflight.modes:
        return "the drive has no torque mode"
    if not preflight.switch_while_enabled:
        return "the drive can't enter torque mode while it turns"
    return "speed mode was asked for" if wanted == Mode.SPEED.value else "speed mode was chosen"


def _with_known_lag(assumptions: ControlAssumptions, prior: LagPrior) -> ControlAssumptions:
    """Reports that are known to lag further than usual are reckoned with by guard, control and stop."""
    known_s = 0.0 if prior.speed_lag_s is None else prior.speed_lag_s + 2.0 * prior.speed_lag_sd_s
    return replace(assumptions, largest_speed_lag_s=max(assumptions.largest_speed_lag_s, known_s))


READ_FILTER_SD_SHARE = 0.1
READ_FILTER_SD_S = 0.001
"""How exactly a filter setting that the drive tells is the lag that it causes."""


def _with_read_filters(prior: LagPrior, filters: ReportingFilters) -> LagPrior:
    """What rig.yaml states goes before what the drive tells of itself."""
    speed, torque = prior.speed_lag_s, prior.torque_lag_s
    sources = [prior.source] if prior.source else []
    if speed is None and filters.speed_lag_s is not None:
        sd = READ_FILTER_SD_SHARE * filters.speed_lag_s + READ_FILTER_SD_S
        prior = replace(prior, speed_lag_s=filters.speed_lag_s, speed_lag_sd_s=sd)
    if torque is None and filters.torque_lag_s is not None:
        sd = READ_FILTER_SD_SHARE * filters.torque_lag_s + READ_FILTER_SD_S
        prior = replace(prior, torque_lag_s=filters.torque_lag_s, torque_lag_sd_s=sd)
    if filters.source:
        sources.append(filters.source)
    return replace(prior, source="; ".join(sources))
