"""`tdhil recover`: the readable content of a damaged log as text, and a clean copy of it."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tdhil.cli.arguments import add_option, require_log
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.errors import ExitCode, MessageCode, UsageError

if TYPE_CHECKING:
    from tdhil.recording import Salvage


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of recover."""
    parser.add_argument("log", type=Path, metavar="broken.mcap", help="the log of a run that was cut short or damaged")
    parser.add_argument("-o", "--output", type=Path, metavar="whole.mcap",
                        help="write the readable part as a finished log; the damaged one is never overwritten")
    add_option(parser, OPTION["json"])
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Recover. Exit 0: nothing is missing; 3: a part is missing; 10 (`NothingRecoverable`): nothing is readable."""
    from tdhil.recording import examine, write_copy
    from tdhil.report import stderr_console
    from tdhil.session import check_log_path, make_room

    path, target = namespace.log, namespace.output
    require_log(path)
    if target is not None and target.exists() and target.samefile(path):
        raise UsageError("would be written over the log itself", where=f"-o {target}", next_step="Name another file",
                         entry=MessageCode.SAME_FILE_TWICE)
    if target is not None:
        check_log_path(target, "-o")
    found = examine(path)
    if target is not None:
        if (older := make_room(target)) is not None:
            stderr_console().print(f"the older {target} was kept as {older}", style="dim", markup=False)
        write_copy(path, target, found)
    code = ExitCode.OK if found.whole else ExitCode.PARTIAL
    document = report(found, path, target) | {"exit_code": int(code)}
    if namespace.json:
        print_json(document)
    else:
        _print(document)
    return int(code)


def report(found: Salvage, path: Path, target: Path | None) -> dict[str, Any]:
    """Return plain data. Times are control time, s; ``under_way``: the stage at the end of the log, or None."""
    from tdhil.runner import STAGES

    run = found.run
    time_s = run.recording.time_s
    begin_s, end_s = (_finite(time_s[0]), _finite(time_s[-1])) if len(time_s) else (None, None)
    known = [stage.name for stage in run.stages]
    over = found.whole or any(stage.outcome == "aborted" for stage in run.stages)
    following = STAGES[STAGES.index(known[-1]) + 1:] if known and known[-1] in STAGES else () if known else STAGES
    verdict = None if run.result is None else run.result.get("verdict")
    return {
        "log": str(path),
        "whole": found.whole,
        "simulated": run.recording.simulated if run.configuration else None,
        "samples": len(time_s),
        "begin_s": begin_s,
        "end_s": end_s,
        "stages": [
            {"name": stage.name, "outcome": stage.outcome, "start_s": _finite(stage.start_s),
             "end_s": _finite(stage.end_s)}
            for stage in run.stages
        ],
        "under_way": None if over or not following or not len(time_s) else following[0],
        "result": {"present": run.result is not None, "verdict": verdict if isinstance(verdict, str) else None},
        "gaps": [{"start_s": _finite(gap.start_s), "end_s": _finite(gap.end_s)} for gap in found.gaps],
        "lost": list(found.lost),
        "copy": None if target is None else str(target),
    }


def _print(document: dict[str, Any]) -> None:
    from tdhil.report import PlainConsole

    console = PlainConsole()

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, markup=False, soft_wrap=True)

    if document["simulated"]:
        say("SIMULATED", "magenta")
    say(f"{document['log']}: {'whole' if document['whole'] else 'partial'}; {_span(document)}")
    for stage in document["stages"]:
        span = f"{_time(stage['start_s'])} to {_time(stage['end_s'])}"
        say(_clean(f"  {stage['name'][:20]:<8} {stage['outcome'][:20]:<9} {span} s"))
    if document["under_way"] is not None:
        say(f"  {document['under_way']:<8} under way when the log ends")
    result = document["result"]
    say(_clean(f"result: {result['verdict'] or 'present'}"[:60]) if result["present"] else "result: none")
    if document["lost"]:
        say("lost:", "yellow")
    for line in document["lost"]:
        say(f"  {_clean(line)}", "yellow")
    copy = document["copy"]
    if copy is not None:
        say(f"copy: {copy} (tdhil replay {copy})")
    elif not document["whole"]:
        say("To write a finished copy: tdhil recover -o whole.mcap " + document["log"])


def _span(document: dict[str, Any]) -> str:
    if not document["samples"]:
        return "no samples"
    return f"{document['samples']} samples, {_time(document['begin_s'])} to {_time(document['end_s'])} s"


def _time(time_s: float | None) -> str:
    return "?" if time_s is None else f"{time_s:.2f}"


def _finite(value: float) -> float | None:
    """Return a number for JSON, which has no NaN; a damaged file may contain it."""
    return float(value) if math.isfinite(value) else None


def _clean(text: str) -> str:
    """Return text of a damaged file for a terminal: on one line, without control characters."""
    return "".join(sign if sign.isprintable() else "·" for sign in text)
