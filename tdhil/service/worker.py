"""Computations for the web: ``python -m tdhil.service.worker plan|replay|…``, with a request on stdin.

They run in a separate process, at a lower priority than every run: neither a page nor a stop waits for them.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from tdhil.errors import UsageError
from tdhil.numerics import prepare
from tdhil.service.run_state import Told, disk_full
from tdhil.service.store import LOG, RECOVERED, Store, read_as

NICE: Final = {"plan": 5, "trend": 5, "report": 5, "preview": 5, "upload": 10, "scan": 0, "check": 0, "pace": 0}
"""Nice values of the tasks for which a page waits. A run by the clock has 0."""
USUAL_NICE: Final = 19


def plan(asked: dict[str, Any]) -> dict[str, Any]:
    """Return the plan of a run on a rig with its present file."""
    from tdhil.service.start_request import plan_of, read_rig

    return {"document": plan_of(read_rig(Path(asked["rig_file"])), asked["options"])}


def pace(asked: dict[str, Any]) -> dict[str, Any]:
    """Measure whether this computer sustains a simulated rig's cycle rate in real time."""
    from tdhil.config import CLOCKS
    from tdhil.service.start_request import read_rig
    from tdhil.session import measure_pace

    found = read_rig(Path(asked["rig_file"]))
    return {"document": measure_pace(*found.way({**asked["options"], CLOCKS[0]: True}), found.rig).plain()}


def replay(asked: dict[str, Any]) -> dict[str, Any]:
    """Identify a run's log again, with another model, tolerance or confidence."""
    from tdhil.api import identify
    from tdhil.config import ASKED_AGAIN
    from tdhil.service.upload_work import read_marked

    os.chdir(asked["folder"])
    given = {one.name: value for one in ASKED_AGAIN if (value := asked.get(one.name)) is not None}
    return {"document": identify(read_marked(), **given).to_dict()}


@contextmanager
def _put(name: str) -> Iterator[Path]:
    """Yield a file that takes the place of ``name`` at the end. A file that is not complete is removed."""
    beside = Path(f".{os.getpid()}-{name}")
    beside.unlink(missing_ok=True)
    try:
        yield beside
        beside.replace(name)
    finally:
        beside.unlink(missing_ok=True)


def report(asked: dict[str, Any]) -> dict[str, Any]:
    """Write the report of a run with a result to the named file."""
    from tdhil.report import require_extra, write_report
    from tdhil.service.letterhead import stored_letterhead
    from tdhil.session import read

    require_extra("report")
    os.chdir(asked["folder"])
    wanted = Path(str(asked["name"])).name
    began_ns = time.time_ns()
    noted = Store(Path("../..")).annotations(Path.cwd().name)
    document = noted.shown_on(_signed(json.loads(Path("result.json").read_bytes())))
    letterhead = stored_letterhead(Path("../.."))
    with _put(wanted) as beside:
        write_report(document, read(LOG).recording, beside, letterhead)
        os.utime(beside, ns=(began_ns, began_ns))      # a change while the report was made makes it outdated
    return {"document": {"file": wanted}}


def _signed(document: dict[str, Any]) -> dict[str, Any]:
    """Return the result in the present folder with the signature under its acceptance, if a person signed it."""
    from tdhil.file_hash import sha256_of
    from tdhil.service.acceptance_signature import FILE, SIGNED, AcceptanceSignature
    from tdhil.service.audit import Audit

    acceptance, signature = document.get("acceptance"), read_as(AcceptanceSignature, Path(FILE))
    if not acceptance or signature is None:
        return document
    audited = Audit(Path("../../audit")).last_details(SIGNED, Path.cwd().name)
    problem = signature.problem(acceptance, sha256_of(Path(LOG), missing=""), audited)
    return {**document, "acceptance": {**acceptance, "signature": {**asdict(signature), "problem": problem}}}


def samples(asked: dict[str, Any]) -> dict[str, Any]:
    """Write the run's samples as samples.csv, as `tdhil export` does."""
    from tdhil.errors import LogError
    from tdhil.recording import read_run, write_samples

    os.chdir(asked["folder"])
    try:
        with _put("samples.csv") as beside:
            write_samples(Path(LOG), beside, int(read_run(Path(LOG)).recording.simulated))
    except LogError as error:
        raise UsageError(error.what, where=error.where, next_step=error.next_step) from error
    return {"document": {"file": "samples.csv"}}


def recover(asked: dict[str, Any]) -> dict[str, Any]:
    """Write a clean copy of a log that broke off, and identify from it. No document if this fails."""
    from tdhil.errors import LogError
    from tdhil.recording import examine, write_copy

    os.chdir(asked["folder"])
    with suppress(LogError, OSError, UsageError):
        if not Path(RECOVERED).exists():
            write_copy(Path(LOG), Path(RECOVERED), examine(Path(LOG)))
    with suppress(LogError, UsageError, ValueError):
        return replay({"folder": asked["folder"]})
    return {"document": None}


def trend(asked: dict[str, Any]) -> dict[str, Any]:
    """Return the trend of a rig's runs."""
    from tdhil.fleet import FleetRow, trend_document

    return {"document": trend_document([FleetRow(**one) for one in asked["rows"]], asked["rig"], rehearsals=True)}


def compare(asked: dict[str, Any]) -> dict[str, Any]:
    """Compare some runs, each identified from its log."""
    from tdhil.fleet import FleetSettings, compare_document, identified

    os.chdir(asked["runs_folder"])
    return {"document": compare_document([identified(Path(run) / LOG,
                                                     FleetSettings()) for run in asked["runs"]])}


def calibrate(asked: dict[str, Any]) -> dict[str, Any]:
    """Return the torque calibration from a run without and a run with a body of known inertia."""
    from tdhil.session import CalibrationRun, document_of_calibration, find_calibration, read

    os.chdir(asked["runs_folder"])
    bodies = ((asked["without"], 0.0, 0.0), (asked["with_body"], asked["added_kg_m2"], asked["added_sd_kg_m2"]))
    runs = [CalibrationRun(read(Path(run) / LOG), added, sd) for run, added, sd in bodies]
    return {"document": document_of_calibration(find_calibration(runs, asked["at"]))}


def scan(asked: dict[str, Any]) -> dict[str, Any]:
    """Scan for the drives at the address of a new rig."""
    from tdhil.service.new_rig import scan_for
    from tdhil.service.schemas import DraftBody, ScanView, adapter, plain

    return {"document": plain(scan_for(adapter(DraftBody).validate_python(asked["draft"])), ScanView)}


def check(asked: dict[str, Any]) -> dict[str, Any]:
    """Check a rig's drive by `tdhil doctor`. It writes no object, and nothing moves."""
    from tdhil.errors import ExitCode
    from tdhil.service.new_rig import document_of

    os.chdir(asked["runs_folder"])
    return {"document": document_of("doctor", Path(asked["rig_file"]), "checks", [ExitCode.OK, ExitCode.REFUSED])}


def preview(asked: dict[str, Any]) -> dict[str, Any]:
    """Return what an uploaded recording contains, and how it is read with the requested mapping."""
    from tdhil.service.upload_work import preview_of

    os.chdir(asked["place"])
    return {"document": preview_of(asked["kind"], asked["options"], readable=asked["read"])}


def upload(asked: dict[str, Any]) -> dict[str, Any]:
    """Identify an uploaded recording. Write log, result and report beside it."""
    from tdhil.service.upload_work import identify_upload

    os.chdir(asked["place"])
    return {"document": identify_upload(asked["kind"], asked["options"], asked["source"])}


def evidence(asked: dict[str, Any]) -> dict[str, Any]:
    """Make the archive of evidence of a run's log, as `tdhil evidence` does."""
    from tdhil.config import EvidenceOptions
    from tdhil.evidence import make_evidence, names_of_this_computer, statement_of
    from tdhil.service.evidence_request import ARCHIVE

    os.chdir(asked["folder"])
    given = EvidenceOptions(**{**asked["stated"], "remove": tuple(asked["stated"]["remove"])})
    statement = statement_of(given)
    made = make_evidence(Path(LOG), statement, (*given.remove, *names_of_this_computer()),
                         serial_key=Path(asked["key_file"]).read_bytes())
    with _put(ARCHIVE) as beside:
        beside.write_bytes(made.archive)
    return {"document": {"sha256": made.sha256, "size_bytes": len(made.archive), "publisher": statement.publisher,
                         "publish": list(statement.publish), "simulated": statement.simulated}}


WORK: Final = {
    "plan": plan, "scan": scan, "check": check, "pace": pace, "replay": replay, "report": report, "samples": samples,
    "recover": recover, "trend": trend, "compare": compare, "calibrate": calibrate, "preview": preview,
    "upload": upload, "evidence": evidence,
}


def main(arguments: list[str]) -> int:
    """Compute one task. Return 0; the reply on stdout contains the result or the error."""
    with suppress(OSError, AttributeError):
        os.nice(NICE.get(arguments[0], USUAL_NICE))
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))      # unfinished files are removed
    with suppress(OSError):                    # without memory, the system ends this process first
        Path("/proc/self/oom_score_adj").write_text("500")
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)                          # output of libraries goes to stderr, not into the reply
    try:
        answer = WORK[arguments[0]](json.load(sys.stdin))
    except Exception as error:
        if not hasattr(error, "next_step"):
            import traceback

            traceback.print_exception(error)
        answer = {"error": Told.of(disk_full(error) or error).__dict__}
    json.dump(answer, out)
    out.flush()
    return 0


if __name__ == "__main__":
    prepare()
    sys.exit(main(sys.argv[1:]))
