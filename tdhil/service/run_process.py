"""The process of one run: the Runner of the command line, the log, and a socket.
The socket accepts confirmation and stop, and reports the status.

``python -m tdhil.service.run_process FOLDER`` with the run's folder, which contains request.json. It is a session of
its own: a failure of the web does not affect it. SIGTERM is a stop, as for `tdhil identify`. The control loop never
waits for a file or a socket: changes are kept in memory, and a thread writes them to disk.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from drivers import Preflight, PreflightRefused
from profiles import MessageCode, visible
from tdhil.config import USUAL_STAGE_S
from tdhil.numerics import prepare
from tdhil.service.attendance import LEASE_S, WATCHED, Board, Confirming, ServiceOperator, Watcher, print_line
from tdhil.service.letterhead import stored_letterhead
from tdhil.service.run_channel import STOP_FILE, ChannelListener
from tdhil.service.run_state import State, Status, Told, Watch, end_of, now, way_to
from tdhil.service.start_request import binding_of, plan_of, read_rig, refuse_changed, run_request
from tdhil.service.store import CONNECTION_FILE, LOG, Store, StoredRequest, read_json, write_json

if TYPE_CHECKING:
    from tdhil.runner import RunOutcome
    from tdhil.session import Rehearsal

NICE: Final = 5
"""Nice value of a simulated run in stepped time, since it uses all available processor time."""
UNWATCHED: Final = "nobody watched"
"""Origin of a stop because no page watched the run."""


class RunProcess:
    """One run from its request to its result; `serve` executes it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.store = Store(self.folder.parent.parent)
        self.request: StoredRequest = self.store.request(self.folder.name)
        self.board = Board(self.store, replace(self.store.status(self.request.id), pid=os.getpid(),
                                               expected_s=dict(USUAL_STAGE_S)))
        self._plan: dict[str, Any] = {}
        from tdhil.runner import StopRequest

        self.stop = StopRequest()
        self.watcher = Watcher(self.board, self.stop)
        self.watched = self.request.motion == "watched"
        self.operator_interface = ServiceOperator(
            self.board, self.watcher, self.folder, self._bind, watched=self.watched, unwatched=self._unwatched
        )

    def serve(self) -> int:
        """Execute the run. Return the exit code of `tdhil identify`."""
        from tdhil.session import stop_on_signals

        with stop_on_signals(self.stop), ChannelListener(self.folder, self.answer):
            try:
                if (early := read_json(self.folder / STOP_FILE)) is not None:
                    self.answer({"do": "stop", "by": early.get("by", "somebody")})
                code = self._run()
            except BaseException as error:
                code = self._failed(error)
            self.board.close()
        return code

    # -- the socket ----------------------------------------------------------------------------------------------

    def answer(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return the reply to one request. Called in a thread of the socket."""
        what, who = asked.get("do"), str(asked.get("by", "somebody"))[:80]
        if what == "stop":
            self._stop(f"{visible(who)} requested a stop", who)
            return {"status": self.board.status.plain()}
        if what == "lease":
            if (lease := self.operator_interface.lease) is None:
                raise PreflightRefused("this run is not watched", where="lease")
            watch = lease.renew(str(asked.get("key", "")), who, new_key=str(asked.get("new_key") or ""),
                                gone=str(asked.get("gone") or ""))
            return {"watch": asdict(watch)}
        if what == "confirm":
            confirming = self.operator_interface.confirming
            if confirming is None:
                raise PreflightRefused("there is nothing to confirm", where="run",
                                       next_step="A simulated rig needs no code. A real one shows it after preflight")
            confirming.take(str(asked.get("code", "")), asked.get("binding"), who, str(asked.get("lease") or ""))
            return {"status": self.board.status.plain()}
        if what == "viewed":
            self.watcher.viewed = True
            return {}
        if what == "code":
            confirming = self.operator_interface.confirming
            waiting = confirming is not None and confirming.confirmed_by is None and confirming.void is None
            if confirming is None or not waiting:
                return {"code": None}
            return {"code": confirming.code, "left_s": confirming.left_s, "binding": confirming.binding}
        return {"status": self.board.status.plain()}

    def _stop(self, why: str, who: str) -> None:
        self.stop.ask(signal.SIGTERM, why)     # first; the control loop reads it in its next cycle
        self.watcher.asked_to_stop(who)

    def _unwatched(self, watch: Watch) -> None:
        self._stop(f"the run was not watched for {LEASE_S:g} s ({WATCHED[watch.how]})", UNWATCHED)

    # -- the run -------------------------------------------------------------------------------------------------

    def _bind(self, preflight: Preflight) -> Confirming:
        checks = [[one.name, one.wanted, one.found, one.outcome.value, one.where] for one in preflight.checks]
        found = {"identity": asdict(preflight.identity), "checks": checks}
        binding = binding_of(self._asked, self.request.rig_sha256, found, self._plan)
        return Confirming(binding, self._refuse_changed, watched=self.watched)

    def _refuse_changed(self) -> None:
        """Raise PreflightRefused if the rig file or the profile has changed."""
        path = Path(self.request.rig_file)
        refuse_changed(path, self.request.rig_sha256)
        _, connection = read_rig(path).way(self.request.options)
        if connection.profile != self._asked.connection.profile:
            raise PreflightRefused("the drive's profile was changed after the run was requested",
                                   where=connection.profile.name, next_step="Nothing has moved; request the run again",
                                   entry=MessageCode.CHANGED_MEANWHILE)

    def _run(self) -> int:
        from tdhil.errors import LogError, exit_code
        from tdhil.report import has_extra
        from tdhil.session import RunSession, kept_connection

        os.chdir(self.folder)
        path = Path(self.request.rig_file)
        rig = read_rig(path)
        refuse_changed(path, self.request.rig_sha256)      # after reading, so that the read file is the requested one
        self.stop.check(next_step="Nothing has moved")
        self.board.to(State.PREFLIGHT)
        self._asked = asked = run_request(rig, self.request.options, left_in=self.store.folder)
        self.watcher.viewed |= not asked.peer.stepped      # in real time the worker process has the time
        if asked.peer.stepped:
            with suppress(OSError):
                os.nice(NICE)
        if self.watched or not asked.peer.embedded:        # the confirmation shows the plan and is bound to it
            self._plan = plan_of(rig, self.request.options)
            write_json(self.folder / "plan.json", self._plan)
            self.board.know(expected_half_width=self._plan["expected_half_width"],
                            expected_s={**USUAL_STAGE_S, "acquire": self._plan["duration_s"] + 5.0})
        if not asked.peer.embedded:        # written before the bus is opened: a later stop goes to this drive only
            write_json(self.folder / CONNECTION_FILE, kept_connection(asked.options, asked.connection))
        report = has_extra()
        self.stop.check(next_step="Nothing has moved")
        session = RunSession(asked, self.operator_interface, report=report)
        self.watcher.log = session.log
        try:
            outcome = session.move(self.stop)
            if self.operator_interface.lease is not None:
                self.operator_interface.lease.end()
            if outcome.cause is not None or (outcome.stop is not None and not outcome.stop.confirmed):
                session.abandon()
                return self._ended(outcome, session.rehearsal)
            self.board.to(State.IDENTIFYING)
            found = session.conclude()
        except BaseException:
            session.abandon()
            raise
        write_json(self.folder / "result.json", found.document)
        code, lost = int(found.exit_code), None
        try:
            session.close()
        except LogError as error:              # standstill is confirmed, and J does not need the rest of the log
            print_line(f"the log is not complete: {error}")
            code, lost = code or int(exit_code(error)), Told.of(error)
        recording = session.log.recording(complete=True)
        self._row(found.document, recording.torque_scale_rel_sd)
        if report:
            self._report(found.document, recording)
        self._end(State.DONE, code, verdict=found.document["verdict"], rehearsal=found.document["rehearsal"],
                  error=lost)
        return code

    def _row(self, document: Mapping[str, Any], torque_scale_rel_sd: float) -> None:
        """Write the run as a row of its rig's history."""
        from tdhil.fleet import FleetSettings, row_of

        try:
            row = row_of(self.request.id, document, settings=FleetSettings(), torque_scale_rel_sd=torque_scale_rel_sd)
            write_json(self.folder / "row.json", asdict(replace(row, rig=self.request.rig)))
        except Exception as error:             # the result is valid without this row
            print_line(f"the history can't be written: {error}")

    def _report(self, document: Mapping[str, Any], recording: Any) -> None:
        from tdhil.errors import UsageError
        from tdhil.report import write_report

        try:
            write_report(document, recording, Path("report.html"), stored_letterhead(self.folder.parent.parent))
        except (UsageError, OSError) as error:
            print_line(f"the report can't be written: {error}")

    def _ended(self, outcome: RunOutcome, rehearsal: Rehearsal | None) -> int:
        from tdhil.errors import ExitCode, exit_code
        from tdhil.runner import not_confirmed

        error: BaseException | None = outcome.cause
        code = exit_code(error) if error is not None else ExitCode.OK
        confirmed = None if outcome.stop is None else outcome.stop.confirmed
        if outcome.stop is not None and not outcome.stop.confirmed:
            error, code = not_confirmed(outcome.stop), ExitCode.STOP_NOT_CONFIRMED
        ended_with, rehearsed = int(code), None
        if rehearsal is not None:
            ended_with, rehearsed = rehearsal.exit_code(int(code)), rehearsal.plain()
        self._end(_cut_short(code, confirmed), ended_with, error=None if error is None else Told.of(error),
                  rehearsal=rehearsed)
        if confirmed:
            self._conclude_part()
        return ended_with

    def _conclude_part(self) -> None:
        """Write the result of an ended run's partial motion, as `tdhil replay` of the log does."""
        from tdhil.errors import TdhilError
        from tdhil.report import has_extra
        from tdhil.session import conclude, is_evaluation, read

        try:
            record = read(self.folder / LOG)
            record.require_motion()
            if record.recording.excitation is None or is_evaluation(record.configuration):
                return
            found = conclude(record.recording, record.configuration, LOG, record.assumed)
        except TdhilError:
            return                             # no data to identify from; the error of the run states why
        except Exception as error:
            print_line(f"the part of the run can't be identified: {error}")
            return
        write_json(self.folder / "result.json", found.document)
        self._row(found.document, record.recording.torque_scale_rel_sd)
        if has_extra():
            self._report(found.document, record.recording)

    def _failed(self, error: BaseException) -> int:
        """End the run after an error before or after the motion. The Runner itself never raises."""
        import traceback

        from tdhil.errors import TdhilError, exit_code

        code = int(exit_code(error))
        if not isinstance(error, TdhilError):
            print_line("".join(traceback.format_exception(error)))
        self._end(_cut_short(code, None), code, error=Told.of(error))
        return code

    def _end(self, state: State, code: int, **known: Any) -> None:
        at = now()

        def step(status: Status) -> Status:
            end = state
            if status.state is State.IDENTIFYING and state in (State.REFUSED, State.STOPPED):
                end = State.FAILED
            return way_to(status, end, at, exit_code=code, confirmation=None, **known)

        self.board.change(step)


def _cut_short(code: int, stop_confirmed: bool | None) -> State:
    """Return the end state of a run without a result. On the command line, a log that broke off is `partial`."""
    state = end_of(code, stop_confirmed=stop_confirmed)
    return State.FAILED if state is State.DONE else state


def main(arguments: list[str]) -> int:
    """Execute the run of this folder. Return the exit code."""
    return RunProcess(Path(arguments[0])).serve()


if __name__ == "__main__":
    prepare()
    sys.exit(main(sys.argv[1:]))
