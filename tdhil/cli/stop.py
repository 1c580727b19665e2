"""`tdhil stop`: best-effort quick stop from outside of a run. It is not an emergency stop."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

from profiles import with_code
from tdhil.errors import ExitCode, MessageCode, UsageError, code_of, exit_code

if TYPE_CHECKING:
    from drivers import BareStopReport

NO_EMERGENCY_STOP = (
    "tdhil stop is NO emergency stop: it needs this computer, the cable and the drive. "
    "Keep the hard-wired emergency stop within reach."
)

NOT_CONFIRMED = "STOP NOT CONFIRMED: use the hard-wired emergency stop now."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of bus and line, as for identify."""
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments, add_option
    from tdhil.config import OPTION

    add_drive_arguments(parser)
    add_option(parser, OPTION["json"])
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Stop. Return 0 at standstill, else 8: still turning, no answer, or no connection to the drive.

    Ctrl-C ends only the observation. The stop request remains active.
    """
    from drivers import Ended, MonotonicClock, bare_stop
    from tdhil.buses import examples
    from tdhil.config import load_rig, resolve
    from tdhil.session import connection_of

    rig = load_rig(namespace.rig) if namespace.rig else None
    options, connection = connection_of(vars(namespace), rig, resolve(vars(namespace), rig))
    if not connection.configured:
        raise UsageError(
            f"{connection.bus.nothing_there}, so nothing was sent, and the shaft may still turn. In danger, use the"
            " hard-wired emergency stop",
            where="stop",
            next_step=f"Type tdhil stop --rig rig.yaml. Without that file, name the profile and the address: --profile"
            f" NAME with {examples()}",
            entry=MessageCode.BUS_NOT_CONFIGURED,
        )
    print(NO_EMERGENCY_STOP, file=sys.stderr)  # noqa: T201
    clock = MonotonicClock()
    try:
        with connection.bus.open_target(options, connection, clock) as target:
            report = bare_stop(target, clock)
    except Exception as error:         # no connection, or a lost one; the driver of an adapter may raise any error
        if exit_code(error) is ExitCode.USAGE:
            raise
        # the connection error alone would not state that the stop did not reach the drive
        as_json, code = namespace.json is True, ExitCode.STOP_NOT_CONFIRMED
        if as_json:
            document = {"ended": "not reached", "error": str(error), "code": code_of(error), "remarks": [],
                        "said": NOT_CONFIRMED, "emergency_stop": False, "exit_code": int(code)}
            print(json.dumps(document, ensure_ascii=False, indent=2))  # noqa: T201
        print(f"tdhil: {with_code(str(error), code_of(error))}", file=sys.stderr)  # noqa: T201
        print(NOT_CONFIRMED, file=sys.stderr if as_json else sys.stdout)
        return int(code)
    except KeyboardInterrupt:
        # a script that reads the exit code only must not take this for a stop
        print(NOT_CONFIRMED, file=sys.stderr)  # noqa: T201
        return int(ExitCode.STOP_NOT_CONFIRMED)
    code = ExitCode.OK if report.ended is Ended.AT_REST else ExitCode.STOP_NOT_CONFIRMED
    if namespace.json is True:
        print(json.dumps(_document(report, code), ensure_ascii=False, indent=2))  # noqa: T201
    else:
        for line in said(report):
            print(line)  # noqa: T201
    return int(code)


def said(report: BareStopReport) -> list[str]:
    """Return the observations, one line each; the last one is the verdict."""
    from drivers import Ended

    lines = []
    if report.first is not None and report.last is not None:
        for when, seen in (("at first", report.first), (f"after {report.took_s:.1f} s", report.last)):
            lines.append(f"{when}: {seen.text}, {seen.speed:.3g} {seen.unit}")
    lines += [f"! {remark}" for remark in report.remarks]
    verdict = {
        Ended.AT_REST: f"The shaft is at standstill. {_holds(report)}",
        Ended.TURNING: f"Standstill was NOT observed. {NOT_CONFIRMED}",
        Ended.NO_ANSWER: f"NO ANSWER: it is unknown whether the shaft turns. {NOT_CONFIRMED}",
    }[report.ended]
    return [*lines, verdict]


def _holds(report: BareStopReport) -> str:
    from drivers import PowerState

    if report.last is not None and report.last.state in (PowerState.OFF, PowerState.READY, PowerState.FAULT):
        return "The drive is disabled: only a brake holds the shaft."
    return "The drive was not disabled: it may hold the shaft."


def _document(report: BareStopReport, code: ExitCode) -> dict[str, object]:
    first, last = (
        None if seen is None else {"state": seen.text, "speed": seen.speed, "unit": seen.unit}
        for seen in (report.first, report.last)
    )
    return {
        "ended": report.ended.value,
        "first": first,
        "last": last,
        "took_s": report.took_s,
        "asked": report.asked,
        "remarks": list(report.remarks),
        "said": "" if code is ExitCode.OK else NOT_CONFIRMED,
        "emergency_stop": False,
        "exit_code": int(code),
    }
