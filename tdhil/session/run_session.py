"""One run, from the request to a closed log: log, drive, Runner, identification.

The command line and the Python API both use it, so that guard, stop and confirmation are the same. The
`OperatorInterface` shows the run and asks the operator. Nothing here prints.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from tdhil.buses import Connection, PeerPlan
from tdhil.config import Expectation, Overrides, Rig, RunOptions, expectations_of, require_name
from tdhil.errors import ExitCode, LogError, TdhilError
from tdhil.recording import FRAME_CHANNELS, RunLog, RunWriter
from tdhil.runner import (
    Display,
    ExcitationRequest,
    Identify,
    Idle,
    Runner,
    RunOutcome,
    StopRequest,
    Task,
    live_inertia,
)
from tdhil.session.dry_run import refuse_hopeless
from tdhil.session.log_files import LogPlace
from tdhil.session.open_drive import opened_drive
from tdhil.session.overrides import accepted_lines, note, require_accepted
from tdhil.session.real_time import real_time_priority
from tdhil.session.rehearsal import Rehearsal, RehearsedShaft, judge_rehearsal
from tdhil.session.stop_signals import stop_on_signals
from tdhil.session.stored_calibration import KEPT, calibration_of_rig, refuse_another_drive
from tdhil.session.task import bench_of, excitation_request, facts, machine_limits, suited
from tdhil.version import __version__

if TYPE_CHECKING:
    from drivers import Identity, Preflight
    from tdhil.session.conclusion import Conclusion
    from tdhil.session.evaluation import EvaluationConclusion
    from tdhil.session.verification import VerificationConclusion
    from tdhil.soft_torque import EvaluationCase
    from tdhil.speed_loop import StepCase


@dataclass(frozen=True)
class RunRequest:
    """Everything that defines a run before a drive is touched."""

    options: RunOptions
    connection: Connection
    peer: PeerPlan
    rig: Rig | None
    overrides: Overrides = field(default_factory=Overrides)
    stated: Mapping[str, str | None] = field(default_factory=dict)
    """Texts that a person states of the run, by the names of `tdhil.config.STATED`."""
    real_time_priority: bool = False
    case: EvaluationCase | StepCase | None = None
    """Virtual string or small steps of the set speed in stage 5, in place of an excitation."""
    acceptance: tuple[Expectation, ...] = ()
    """Expected values that decide whether the result is accepted."""

    @classmethod
    def of(
        cls, options: RunOptions, connection: Connection, peer: PeerPlan, rig: Rig | None, *, overrides: Overrides,
        stated: Mapping[str, str | None] = MappingProxyType({}), real_time_priority: bool = False,
        case: EvaluationCase | StepCase | None = None, expect: Sequence[str] = (),
    ) -> RunRequest:
        """Return the request, with limits that suit the plant. Raises PreflightRefused for motion beyond the limits."""
        bench = suited(rig, peer.plant)
        if case is None:
            refuse_hopeless(options, bench, connection.profile)
        return cls(options, connection, peer, bench, overrides, stated, real_time_priority, case,
                   expectations_of({} if bench is None else bench.acceptance, expect))


class OperatorInterface(Protocol):
    """The operator during a run: watches the display, confirms motion, confirms the speed."""

    def watch(self) -> AbstractContextManager[Display]:
        """Show this run until the block ends."""
        ...

    def confirm(self, task: Task, preflight: Preflight, idle: Idle, unverified: tuple[str, ...]) -> None:
        """Return if the shaft may be moved; raise PreflightRefused if not."""
        ...

    def confirm_speed(self, speed_rad_s: float, why: str, idle: Idle) -> None:
        """Return if the operator sees the shaft turn at that speed; raise PreflightRefused if not."""
        ...

    def say(self, text: str) -> None:
        """Show one line of information."""
        ...

    def warn(self, text: str) -> None:
        """Show one line as a warning."""
        ...


class RunSession:
    """One run. `move` runs the drive, `conclude` identifies. `close` always follows, or `abandon` after a failure."""

    def __init__(self, request: RunRequest, operator_interface: OperatorInterface, *, report: bool = False) -> None:
        """Open the log only. ``report``: a report will be written, so its modules are loaded too."""
        load_what_the_end_needs(report, case=request.case is not None, rehearsal=bool(request.peer.faults))
        options, peer = request.options, request.peer
        self._request, self._operator_interface = request, operator_interface
        self._place = place = LogPlace(Path(options.log))
        writer = RunWriter(place.wanted, epoch_ns=peer.epoch_ns, block=peer.stepped, opener=place.open,
                           frames=FRAME_CHANNELS[request.connection.bus.frame_topic])
        writer.path = place.path
        if place.live:
            operator_interface.warn(f"another run writes {place.wanted}: the log of this run is {place.path}")
        self._older_shown = False
        self._outcome: RunOutcome | None = None
        self._shaft = RehearsedShaft()
        self.rehearsal: Rehearsal | None = None
        """Verdict on the rehearsed faults, once the run has ended; None without faults."""
        self.log = RunLog(writer, configuration(request) | dict(request.stated))

    @property
    def path(self) -> Path:
        """Return the log's final path, also if its folder was renamed during the run."""
        with suppress(LogError):           # `close` reports it
            self._place.follow()
        return self._place.name(stub=self._stub)

    @property
    def _stub(self) -> bool:
        stopped = self._outcome is not None and self._outcome.stop is not None
        return not (self._place.motion or stopped)

    def move(self, stop: StopRequest | None = None) -> RunOutcome:
        """Connect, run the five stages, stop, close. Raises the error that prevents opening the drive.

        ``stop``: a request from elsewhere. Signals set it too, if this is the main thread.
        """
        try:
            return self._move(stop)
        except TdhilError as error:
            if self._outcome is None:       # without it the log would be reported as too short
                with suppress(LogError):
                    self.log.failure(0.0, error)
            raise

    def _move(self, stop: StopRequest | None) -> RunOutcome:
        request, log, operator_interface = self._request, self.log, self._operator_interface
        options, connection, peer, rig = request.options, request.connection, request.peer, request.rig
        data = rig.drive_data if rig is not None else None
        with self._traced() as trace, stop_on_signals(stop) as stop_request, opened_drive(
            peer, options, connection, data, log.frame, trace
        ) as drive, operator_interface.watch() as display, real_time_priority(
            request.real_time_priority, stepped=peer.stepped
        ) as raised:
            if raised.said:
                log.configure(real_time_priority=raised.plain())
                operator_interface.say(raised.said)
            self._outcome = outcome = Runner(
                drive,
                self._task,
                log,
                stop_request,
                display,
                self._confirm,
                reset_fault=request.overrides.reset_fault,
                say=operator_interface.say,
                confirm_speed=operator_interface.confirm_speed,
                identify=self._identify,
            ).run()
        if outcome.cause is not None or (outcome.stop is not None and not outcome.stop.confirmed):
            self._judge()
        for fault in peer.never_came:
            with suppress(LogError):
                log.event(drive.clock.now_s(), "fault", f"--fault {fault} was not triggered")
            operator_interface.warn(f"tdhil: --fault {fault} was not triggered: the run ended before its time")
        return outcome

    @contextmanager
    def _traced(self) -> Iterator[Path | None]:
        """Yield the file of the simulated shaft's motion. A rehearsal has one also without --trace, and reads it at
        the end. If that fails, the run goes on, and its rehearsal does not pass.
        """
        wanted, rehearsed = self._request.options.trace, bool(self._request.peer.faults)
        with ExitStack() as stack:
            path = None if wanted is None else Path(wanted)
            if path is None and rehearsed:
                try:
                    folder = stack.enter_context(TemporaryDirectory(prefix="tdhil-", ignore_cleanup_errors=True))
                    path = Path(folder) / "shaft.csv"
                except OSError as error:
                    self._shaft = RehearsedShaft(missing=f"no temporary folder: {error}")
            try:
                yield path
            finally:
                if path is not None and self._outcome is not None:
                    self._shaft = self._rehearsed_shaft(path)

    def _rehearsed_shaft(self, path: Path) -> RehearsedShaft:
        """Return what the trace of a run that has ended shows. Warn if --trace has no whole file."""
        options = self._request.options
        if not path.is_file():
            if options.trace is not None:
                self._operator_interface.warn(
                    f"tdhil: --trace {options.trace}: the file could not be written to the end. Is the disk full?")
            return RehearsedShaft(missing="its trace could not be written to the end")
        if not self._request.peer.faults:
            return RehearsedShaft()
        from sim_bus import read_shaft

        try:
            return RehearsedShaft(read_shaft(path))
        except (OSError, ValueError) as error:
            return RehearsedShaft(missing=f"its trace cannot be read: {error}")

    def _identify(self) -> Identify:
        """Return the function that identifies the recording during the run, as `conclude` does at its end."""
        from tdhil.session.conclusion import identified_so_far

        return partial(identified_so_far, self.log.run)

    def conclude(self) -> Conclusion | EvaluationConclusion | VerificationConclusion:
        """Identify, evaluate the virtual string or compare the steps, from the recording, and log the result."""
        from tdhil.session.conclusion import Conclusion, conclude_run

        recording = self.log.recording(complete=True)
        found = conclude_run(recording, self.log.run, str(self.path), self.log.virtual_string)
        if isinstance(found, Conclusion) and recording.excitation is not None:
            confidence = float(self.log.run["identify"]["confidence"])
            with suppress(LogError):           # J of the result is the last one of the run
                self.log.inertia(live_inertia(found.identification, recording, confidence))
        self._judge(found.document, int(found.exit_code))
        if self.rehearsal is not None:
            from tdhil.report import rehearsal_of

            plain = rehearsal_of(self.log.run)
            found = replace(found, document=found.document | {"rehearsal": plain},
                            exit_code=ExitCode(self.rehearsal.exit_code(int(found.exit_code))))
        with suppress(LogError):  # a log failure must not lose the result; `close` reports it
            self.log.result(found.document)
        return found

    def _judge(self, document: Mapping[str, Any] | None = None, code: int | None = None) -> None:
        """Judge the rehearsed faults, if any, and write the verdict to the log."""
        request, outcome = self._request, self._outcome
        if not request.peer.faults or outcome is None:
            return
        other = request.case is not None or request.options.impedance
        bench = self.log.run.get("bench")
        self.rehearsal = judge_rehearsal(
            request.peer, request.connection.drive, outcome, document, code, other_program=bool(other),
            shaft=self._shaft if bench is None else replace(
                self._shaft, speed_max_rad_s=bench["limits"]["speed_max_rad_s"]))
        with suppress(LogError):
            self.log.configure(rehearsal=self.rehearsal.plain())

    def close(self) -> None:
        """Finish the log. Raises LogError; the file gets its final name also in this case."""
        try:
            self.log.close()
            self._place.follow()
        finally:
            self._settle()

    def abandon(self) -> None:
        """Finish the log after another error. Raises no error of the log."""
        with suppress(LogError):
            self.log.close()
        self._settle()

    def _settle(self) -> None:
        if self._place.moved:
            self._operator_interface.warn(f"tdhil: {self._place.moved}")
        self._place.settle(stub=self._stub)
        self._tell_older()

    def _tell_older(self) -> None:
        """Report once the new place of an older log. Wait until this is certain: a refused run returns the name."""
        older = self._place.older
        if not self._older_shown and older is not None and older.exists():
            self._older_shown = True
            self._operator_interface.say(f"the older {self._place.wanted} was kept as {older}")

    def _confirm(self, task: Task, preflight: Preflight, idle: Idle) -> None:
        request = self._request
        taken = accepted_lines(request.connection.profile, request.options.accept_unverified)
        self._operator_interface.confirm(task, preflight, idle, taken)
        self._place.motion = True
        self._tell_older()

    def _task(self, identity: Identity) -> Task:
        request, log = self._request, self.log
        profile, overrides, accepted = request.connection.profile, request.overrides, request.options.accept_unverified
        highest_rad_s = request.options.highest_speed_rad_s
        bench = bench_of(identity.simulated, request.rig, highest_rad_s)
        log.configure(bench=bench.model_dump(mode="json", by_alias=True), identity=asdict(identity))
        refuse_another_drive(log.run, asdict(identity))
        if not identity.simulated:
            require_accepted(profile, accepted)
            log.configure(unverified=list(accepted_lines(profile, accepted)))
        elif text := note(profile):
            self._operator_interface.say(text)
        rig_limits = None if highest_rad_s is None else bench_of(identity.simulated, request.rig).limits
        limits = machine_limits(
            bench,
            rig_speed_max_rad_s=0.0 if rig_limits is None else rig_limits.speed_max_rad_s,
            accept_no_watchdog=overrides.no_watchdog,
            accept_shared_watchdog=overrides.shared_watchdog,
            accept_wider=overrides.wider_limits,
            accept_speed_unit=overrides.speed_unit,
        )
        if not identity.simulated:
            require_name(request.rig)
        asked = excitation_request(request.options, bench)
        if request.case is not None:
            asked = ExcitationRequest(mode=request.case.mode, reference_filter_s=asked.reference_filter_s)
        return Task(limits, asked, facts(bench), case=request.case, calibrated=KEPT in log.run)


def configuration(request: RunRequest) -> dict[str, Any]:
    """Return the configuration for the log: everything that identification needs.

    It includes the whole profile, so that a later decoder can start from the raw frames.
    """
    options, connection, peer, rig = request.options, request.connection, request.peer, request.rig
    calibration = calibration_of_rig(rig)
    return {
        "tdhil": __version__,
        **({} if calibration is None else {KEPT: calibration}),
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "rig_file": None if rig is None or not rig.file else rig.file,
        "options": {name: {"value": value, "source": source} for name, value, source in options.rows()},
        "drive": connection.drive,
        "bus": {name: {"value": value, "source": source} for name, value, source in connection.line.rows()},
        "profile": connection.profile.model_dump(mode="json", by_alias=True),
        "embedded_simulator": peer.embedded,
        "stepped": peer.stepped,
        "seed": peer.seed,
        "plant": None if peer.plant is None else peer.plant.model_dump(mode="json"),
        "faults": [fault.text for fault in peer.faults],
        "identify": {"confidence": options.confidence, "tolerance": options.tolerance, "model": options.model},
        "converted": [list(row) for row in rig.conversions] if rig is not None else [],
        **({"acceptance": [asdict(one) for one in request.acceptance]} if request.acceptance else {}),
        "reference_inertia_kg_m2": None if rig is None else rig.reference_inertia_kg_m2,
    }


def load_what_the_end_needs(report: bool, case: bool, rehearsal: bool) -> None:
    """Import the modules for stop and result before motion: later there may be no file descriptor left.

    ``case``: the run compares a controller or its gains, instead of identifying. ``rehearsal``: it has scripted faults.
    """
    import traceback  # noqa: F401

    import scipy.optimize
    import scipy.special  # noqa: F401
    from rich.console import Console

    from tdhil.estimation import (
        Verdict,  # noqa: F401
        identify,  # noqa: F401
    )
    from tdhil.report import card_text, result_document, write_report  # noqa: F401
    from tdhil.session import conclusion, evaluation, verification  # noqa: F401

    with Console(file=io.StringIO()).status(""):
        pass      # rich loads its spinners at first use
    if rehearsal:
        from sim_bus import read_shaft  # noqa: F401
    if report:
        from tdhil.report import draw_run, require_extra  # noqa: F401
    if case:
        from tdhil.report import evaluation_document, verification_document  # noqa: F401
        from tdhil.speed_loop import verify_record  # noqa: F401
    if case and report:
        from tdhil.report import evaluation_report, verification_report  # noqa: F401
